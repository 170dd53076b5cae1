"""rl-zoo3's programs with TDPG among its algorithms: train, watch, tune and plot from the command line."""

from sb3_tdpg.zoo.manager import register

__all__ = ["register"]
