"""Run the command-line programs of rl-zoo3 with a few additional flags of this package."""

import argparse
import json
import os
import runpy
import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import rl_zoo3.train
import yaml
from rl_zoo3.utils import StoreDict

from sb3_tdpg.common.trust import PlainLoader, check_plain, say_what_is_trusted
from sb3_tdpg.zoo.manager import CHECKPOINT, RECORD, TDPGExperimentManager, register

# The zoo's default of five episodes is too small to measure the information.
TUNING_DEFAULTS = ("--eval-episodes", "200", "--n-trials", "50", "--num-threads", "1", "--verbose", "0")
HELP = {"-h", "--help"}
LOGS, FILES = ("-tb", "--tensorboard-log"), ("-conf", "--conf-file", "-i", "--trained-agent")
BLOCK = dict(help="block of hyperparameters (default: the environment's block)")
# The additional flags of each program.
FLAGS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "train": {
        "--block": BLOCK,
        "--resume": dict(type=Path, metavar="FOLDER", help="continue an interrupted training of TDPG"),
    },
    "tune": {
        "--block": BLOCK,
        "--objective": dict(
            choices=("information", "shift"),
            help="for TDPG: minimise the information under the cost limit, or the cost under --eval-env-kwargs "
            "(default if these are given)",
        ),
        "--cost-limit": dict(type=float, help="limit on the expected cost (default: from the block or environment)"),
        "--space": dict(type=Path, metavar="FILE", help="search space, in the form of hyperparams/tdpg-search.yml"),
    },
    "plot": {
        "--kind": dict(choices=("train", "from-file", "all"), default="train", help="which plot of the zoo"),
        "--save": dict(type=Path, metavar="FILE", help="write the figure to this file instead of showing it"),
    },
}


def run(program: str, arguments: Sequence[str]) -> None:
    """
    Run a program of the zoo (``train``, ``tune``, ``enjoy``, ``record-video`` or ``plot``) with its flags and ours.

    :raises ValueError: if the zoo does not accept the arguments.
    """
    given, flags = _split(program, arguments)
    register()
    # The zoo's programs read their flags from sys.argv.
    argv, sys.argv = sys.argv, [f"sb3-tdpg {program}"]
    try:
        if program in ("enjoy", "record-video"):
            _watch(program.replace("-", "_"), given, flags)
        else:
            dict(train=_train, tune=_tune, plot=_plot)[program](given, flags)
    except (AssertionError, yaml.YAMLError, gym.error.Error) as e:  # the zoo raises these for bad input
        raise ValueError(" ".join(str(e).split())) from e
    finally:
        sys.argv = argv


class _PlainDict(StoreDict):
    """Parse ``key:value`` and accept only plain data, because the zoo evaluates the value as code."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        for text in values:
            check_plain(text.partition(":")[2], f"{RECORD} has {option_string} {text.partition(':')[0]}:")
        super().__call__(parser, namespace, values, option_string)


def _split(
    program: str, arguments: Sequence[str], keywords: type[StoreDict] = StoreDict
) -> tuple[argparse.Namespace, list[str]]:
    """Return the values of this package's flags, and the remaining flags for the zoo."""
    ours = argparse.ArgumentParser(f"sb3-tdpg {program}", add_help=False, allow_abbrev=False)
    for flag, options in FLAGS.get(program, {}).items():
        ours.add_argument(flag, **options)
    if program in FLAGS and HELP & set(arguments):
        ours.print_help()
        print("\nand all flags of rl-zoo3:\n")
    given, flags = ours.parse_known_args(arguments)
    shared = argparse.ArgumentParser(ours.prog, add_help=False, allow_abbrev=False)
    shared.add_argument("--algo", default="tdpg")
    shared.add_argument("-f", "--folder", default="logs")
    for names in (["--env-kwargs"], ["--eval-env-kwargs"], ["-params", "--hyperparams"]):
        shared.add_argument(*names, nargs="+", action=keywords)
    try:
        shared.parse_known_args(flags, given)
    except (NameError, SyntaxError) as e:
        raise ValueError(f"{e}: write key:value with a value in Python, text in quotes as in key:\"'text'\"") from e
    return given, flags


def _say_what_is_loaded(flags: list[str], *paths: str | Path) -> None:
    """Print the files that the program trusts, except with ``--help``, which loads no file."""
    if not HELP & set(flags):
        say_what_is_trusted(*paths)


def _train(given: argparse.Namespace, flags: list[str]) -> None:
    folder, seed = given.resume, []
    rl_zoo3.train.StoreDict = StoreDict if folder is None else _PlainDict  # type: ignore[misc]
    _say_what_is_loaded(flags, *(flag for flag in flags if flag.endswith(".zip")))  # the values of -i
    if folder is not None:
        record = _read_record(folder, bool(flags or given.block))
        say_what_is_trusted(folder)
        given, flags = _split("train", record["arguments"], _PlainDict)
        seed = ["--seed", str(record["seed"])]  # a random seed if the first start gave none
    if given.algo == "tdpg" and {"-optimize", "--optimize-hyperparameters", "--storage"} & set(flags):
        raise ValueError("tune TDPG with `sb3-tdpg tune`; to train, give the best.yml of a study with --conf-file")
    typed = ["--block", given.block, *flags] if given.block else flags
    # Paths become absolute, so that --resume works in any folder. Another word is the name of a package.
    recorded = [
        os.path.abspath(word) if flag in LOGS or (flag in FILES and os.path.exists(word)) else word
        for flag, word in zip(["", *typed], typed, strict=False)
    ]

    class Manager(TDPGExperimentManager):
        block, resume, arguments = given.block, folder, tuple(recorded)

    register(Manager)
    sys.argv += ["--algo", "tdpg", *flags, *seed]
    rl_zoo3.train.train()


def _read_record(folder: Path, has_flags: bool) -> dict[str, Any]:
    """Return the record of how the training in a folder was started; raise an error if it cannot be resumed."""
    if not (folder / RECORD).exists():
        raise ValueError(f"--resume {folder} is not the folder of a training: it has no {RECORD}")
    record: dict[str, Any] = json.loads((folder / RECORD).read_text())
    if has_flags:
        raise ValueError(
            f"{folder} was started with `{' '.join(record['arguments'])}`, and other flags cannot change it: give "
            "--resume alone, or train anew without it"
        )
    if not (folder / CHECKPOINT).exists():
        raise ValueError(f"--resume {folder} has no {CHECKPOINT}: its training is finished, or had hardly begun")
    return record


def _tune(given: argparse.Namespace, flags: list[str]) -> None:
    from sb3_tdpg.zoo.tuning import TuningManager

    if given.algo != "tdpg" and (given.objective, given.cost_limit, given.space) != (None, None, None):
        raise ValueError(f"--objective, --cost-limit and --space are for TDPG, not for {given.algo}")
    base: Any = TuningManager if given.algo == "tdpg" else TDPGExperimentManager

    class Manager(base):
        block, objective_kind = given.block, given.objective
        cost_limit, space_path = given.cost_limit, given.space

    register(Manager)
    sys.argv += ["--algo", "tdpg", "--optimize-hyperparameters", *TUNING_DEFAULTS, *flags]
    rl_zoo3.train.train()


def _watch(program: str, given: argparse.Namespace, flags: list[str]) -> None:
    """Run ``enjoy`` or ``record-video`` on models in ``train``'s folder, with the stochastic policy for TDPG."""
    is_stochastic = given.algo == "tdpg" and "--deterministic" not in flags
    _say_what_is_loaded(flags, given.folder)
    sys.argv += ["--algo", "tdpg", "-f", "logs", *(["--stochastic"] if is_stochastic else []), *flags]
    unsafe, yaml.UnsafeLoader = yaml.UnsafeLoader, PlainLoader  # the zoo's loader would run code in a file
    try:
        runpy.run_module(f"rl_zoo3.{program}", run_name="__main__")
    finally:
        yaml.UnsafeLoader = unsafe


def _plot(given: argparse.Namespace, flags: list[str]) -> None:
    import matplotlib.pyplot as plt
    from rl_zoo3.plots import all_plots, plot_from_file, plot_train

    sys.argv += [*(["-a", "tdpg", "-f", "logs"] if given.kind == "train" else []), *flags]
    if given.save is not None:
        plt.switch_backend("agg")  # the plots end with plt.show(), which does nothing with this backend
        warnings.filterwarnings("ignore", message="FigureCanvasAgg is non-interactive")
    if given.kind == "from-file":
        _say_what_is_loaded(flags, *(flag for flag in flags if Path(flag).is_file()))
    {"train": plot_train, "from-file": plot_from_file, "all": all_plots}[given.kind]()
    if given.save is not None and plt.get_fignums():  # --kind all prints tables only
        if not any(axes.has_data() for axes in plt.gcf().axes):
            mend = "name trainings of at least 100 episodes (--episode-window), or results with evaluations"
            raise ValueError(f"`{' '.join(flags)}` gives an empty figure: {mend}")
        given.save.parent.mkdir(parents=True, exist_ok=True)
        plt.savefig(given.save, dpi=150)
        plt.close()  # otherwise the next plot would draw into this figure
        print(f"the figure is in {given.save}")
