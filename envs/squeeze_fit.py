"""
Fit the batched model SqueezeInsert-v0 to PyBullet's squeezes: ``python -m sb3_tdpg.envs.squeeze_fit``.

The result is :data:`sb3_tdpg.envs.scenarios.PANDA_SQUEEZE`.
"""

import math
from typing import NamedTuple

import numpy as np

from .panda_squeeze import PandaSqueezeEnv
from .squeeze_insert import RIGHT_ANGLE, wrap

NEAR = math.radians(3.0)  # a part that ends within this angle of the jaws, or of lying across them, has been turned
FAR = math.radians(20.0)  # a part that starts within this angle of its final yaw says little about `turn`


class SqueezeFit(NamedTuple):
    """Fitted keywords of SqueezeInsert-v0, and their errors against PyBullet's squeezes; angles in rad."""

    turn: tuple[float, float]  # 5 % and 95 % quantiles of the fraction of the way that a squeeze turns the part
    basin: float  # middle of the gap between aligned_up_to and across_from
    aligned_up_to: float  # largest angle between part and jaws at which the part turned towards the jaws
    across_from: float  # smallest angle between part and jaws at which the part turned across the jaws
    stuck: float  # fraction of the parts that turned neither towards the jaws nor across them
    residual: float  # root mean square error of the model with the mean turn, without the stuck parts
    worst: float  # largest error of this model, without the stuck parts


def fit_squeeze(env: PandaSqueezeEnv, n: int = 720, seed: int = 0) -> SqueezeFit:
    """
    Squeeze parts in PyBullet, and fit ``turn`` and ``basin``.

    :param env: The environment whose squeezes are to be fitted.
    :param n: Number of squeezes. The angles between part and jaws form a grid in (-pi/2, pi/2). The yaws of the jaws
        are drawn uniformly.
    :param seed: Seed of the yaws of the jaws and of the centring errors.
    """
    env.reset(seed=seed)
    away = (np.arange(n) + 0.5) / n * math.pi - RIGHT_ANGLE
    jaws = env.np_random.uniform(-RIGHT_ANGLE, RIGHT_ANGLE, n)
    yaw = away + jaws
    step = env.step_batch(np.column_stack([np.sin(2 * yaw), np.cos(2 * yaw)]), jaws[:, None], is_last=False)
    left = wrap(env.yaw(step.state) - jaws)
    return fit_angles(away, left)


def fit_angles(away: np.ndarray, left: np.ndarray) -> SqueezeFit:
    """
    Fit ``turn`` and ``basin`` to angles between part and jaws.

    :param away: Angles before a squeeze, ``(N,)`` in rad.
    :param left: Angles after the squeeze, ``(N,)`` in rad.
    :raises ValueError: if no part turned towards the jaws, or no part turned across them.
    """
    is_aligned, is_across = np.abs(left) < NEAR, np.abs(left) > RIGHT_ANGLE - NEAR
    if not (is_aligned.any() and is_across.any()):
        raise ValueError("no part turned towards the jaws, or none across them: there is nothing to fit")
    aligned_up_to, across_from = float(np.abs(away[is_aligned]).max()), float(np.abs(away[is_across]).min())
    rest = np.where(is_aligned, 0.0, np.sign(away) * RIGHT_ANGLE)
    is_turned = is_aligned | is_across
    far = is_turned & (np.abs(rest - away) > FAR)
    # The absolute values keep the fraction at 1 or below, also for a part that turned beyond its final yaw.
    share = 1 - np.abs(wrap(rest - left))[far] / np.abs(rest - away)[far]
    low, high = np.quantile(share, [0.05, 0.95]).tolist()
    predicted = away + (low + high) / 2 * (rest - away)
    error = np.abs(wrap(left - predicted))[is_turned]
    return SqueezeFit(
        turn=(low, high),
        basin=(aligned_up_to + across_from) / 2,
        aligned_up_to=aligned_up_to,
        across_from=across_from,
        stuck=float(1 - is_turned.mean()),
        residual=float(np.sqrt((error**2).mean())),
        worst=float(error.max()),
    )


def main() -> None:
    """Fit the default PandaSqueeze-v0, and print the result."""
    env = PandaSqueezeEnv()
    fit = fit_squeeze(env)
    env.close()
    print(f"turn=({fit.turn[0]:.3f}, {fit.turn[1]:.3f}), basin=radians({math.degrees(fit.basin):.1f})")
    for name in ("aligned_up_to", "across_from", "residual", "worst"):
        print(f"{name}: {math.degrees(getattr(fit, name)):.2f} degrees")
    print(f"stuck: {100 * fit.stuck:.1f} %")


if __name__ == "__main__":
    main()
