"""Cost on Lava when observations are missing: ``missing_observations.py PG TDPG FIGURE``."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from sb3_tdpg import TDPG, make_episodes_env

SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the observations that are missing
N_EPISODES = 1000


def mean_cost(model: TDPG, share: float) -> float:
    """Run episodes in which each observation is missing with a probability: the last one is given again, at first 0."""
    env, rng = make_episodes_env("Lava-v0", n_envs=N_EPISODES, seed=0), np.random.default_rng(0)
    model.set_random_seed(0)
    observation, seen, memory = env.reset(), np.zeros((N_EPISODES, 2), np.float32), None
    costs = np.zeros(N_EPISODES)
    for _ in range(model.horizon):
        seen = np.where(rng.random((N_EPISODES, 1)) < share, seen, observation)
        actions, memory = model.predict(seen, memory)
        observation, rewards, _, _ = env.step(actions)
        costs -= rewards
    return float(costs.mean())


def main(pg: Path, tdpg: Path, figure: Path) -> None:
    """Draw the costs of every model, and print their means over the models."""
    _, axes = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
    for name, folder, colour in (("PG", pg, "C1"), ("TDPG", tdpg, "C0")):
        models = [TDPG.load(path, device="cpu") for path in sorted(folder.rglob("Lava-v0.zip"))]
        costs = np.array([[mean_cost(model, share) for share in SHARES] for model in models])
        axes.plot(SHARES, costs.T, ".", color=colour, alpha=0.6)
        axes.plot(SHARES, costs.mean(0), color=colour, label=f"{name} ({len(models)} models)")
        print(name, *(f"{mean:.1f} ({low:.1f} to {high:.1f})" for mean, low, high in zip(
            costs.mean(0), costs.min(0), costs.max(0), strict=True)))  # fmt: skip
    axes.set(xlabel="share of the observations that are missing", ylabel="mean cost of an episode", ylim=(0, None))
    axes.set_xticks(SHARES)
    axes.legend()
    plt.savefig(figure, dpi=130)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
