"""Train, watch, tune and plot from the command line: the programs of rl-zoo3 with TDPG among the algorithms."""

from sb3_tdpg.zoo.manager import register

__all__ = ["register"]
