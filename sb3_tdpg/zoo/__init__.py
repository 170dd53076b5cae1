"""Train, watch, tune and plot from the command line, with the programs of rl-zoo3 and TDPG as an algorithm."""

from sb3_tdpg.zoo.manager import register

__all__ = ["register"]
