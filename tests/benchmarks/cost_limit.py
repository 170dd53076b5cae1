"""
Does the last policy of ``beta="auto"`` keep its limit? ``python tests/benchmarks/cost_limit.py Lava-v0 CartPole-v1``.

Each environment has ten training seeds, each evaluated with the policy's noise. Half a minute of one core for each
policy of these two.
"""

from __future__ import annotations

import argparse

from stable_baselines3.common.evaluation import evaluate_policy

from sb3_tdpg import TDPG, make_episodes_env

N_ENVS = 10


def main() -> None:
    """Print the cost, the limit and what was kept of the information, for each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env", nargs="+")
    parser.add_argument("--first-seed", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--cost-limit", default="95%")
    parser.add_argument("-n", "--n-timesteps", type=int, help="default: that of the kind of problem")
    parser.add_argument("--n-eval-episodes", type=int, default=100)
    given = parser.parse_args()
    for env_id in given.env:
        n_met = 0
        for seed in range(given.first_seed, given.first_seed + given.seeds):
            model = TDPG("TRVPolicy", env_id, beta="auto", cost_limit=given.cost_limit, seed=seed)
            model.learn(given.n_timesteps)
            assert model.auto_weight is not None
            env = make_episodes_env(env_id, N_ENVS, seed=seed + 1000)
            mean, _ = evaluate_policy(model, env, given.n_eval_episodes, deterministic=False)
            is_met = -float(mean) <= model.auto_weight.limit
            n_met += is_met
            verdict = "met" if is_met else "MISSED"
            print(f"{env_id}, seed {seed}: {-float(mean):.4g}, {model.auto_weight.kept()}, {verdict}")
        print(f"{env_id}: {n_met} of {given.seeds} policies keep the limit")


if __name__ == "__main__":
    main()
