"""rl-zoo3's command-line programs, with the flags that this plugin adds."""

from __future__ import annotations

import argparse
import contextlib
import json
import runpy
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import rl_zoo3.train
from rl_zoo3.utils import StoreDict

from sb3_tdpg.zoo.manager import CHECKPOINT, RECORD, TDPGExperimentManager, register

# Of five episodes, the zoo's default, no information could be told.
TUNING_DEFAULTS = ("--eval-episodes", "200", "--n-trials", "50", "--num-threads", "1", "--verbose", "0")


def run(program: str, arguments: Sequence[str]) -> None:
    """
    Run one of the zoo's programs.

    :param program: A key of :data:`PROGRAMS`.
    :param arguments: Its flags: those of the zoo, and a few of ours, which ``--help`` tells.
    :raises ValueError: if the zoo cannot do what they ask for.
    """
    register()
    try:
        PROGRAMS[program](list(arguments))
    except AssertionError as e:  # with these it refuses bad input
        raise ValueError(" ".join(str(e).split())) from e


def _train(arguments: list[str]) -> None:
    ours = _parser("train")
    ours.add_argument("--block", help="block of hyperparameters (default: that of the environment)")
    ours.add_argument("--resume", type=Path, metavar="FOLDER", help="go on with an interrupted training of TDPG")
    if _wants_help(arguments):
        ours.print_help()
        print("\nand all flags of rl-zoo3:\n")
    given, rest = ours.parse_known_args(arguments)
    manager = TDPGExperimentManager
    manager.block, manager.resume, manager.arguments = given.block, given.resume, tuple(arguments)
    manager.was_interrupted = False
    if given.resume is not None:
        others = [a for a in arguments if a not in ("--resume", f"--resume={given.resume}", str(given.resume))]
        record = _read_record(given.resume, others)
        given, rest = ours.parse_known_args(record["arguments"])
        manager.block = given.block
        # Without --seed it was drawn, and has to be the same now.
        rest += ["--seed", str(record["seed"])]
    _check_dictionaries(rest)
    with _flags("train", ["--algo", "tdpg", *rest]):
        rl_zoo3.train.train()
    if manager.was_interrupted:
        raise KeyboardInterrupt


def _tune(arguments: list[str]) -> None:
    from sb3_tdpg.zoo.tuning import OBJECTIVES, TuningManager

    ours = _parser("tune")
    ours.add_argument("--block", help="block of hyperparameters that is tuned (default: that of the environment)")
    ours.add_argument(
        "--objective", choices=OBJECTIVES,
        help="of TDPG: the least information under the cost limit, or the least cost under --eval-env-kwargs (default: "
        "the latter if they are given)",
    )  # fmt: skip
    ours.add_argument("--cost-limit", type=float, help="on the expected cost (default: the block's, the environment's)")
    ours.add_argument("--space", type=Path, metavar="FILE", help="search space like hyperparams/tdpg-search.yml")
    if _wants_help(arguments):
        ours.print_help()
        print("\nand all flags of rl-zoo3; of TDPG --n-trials and --max-total-trials both count all workers' trials:\n")
    given, rest = ours.parse_known_args(arguments)
    manager = TuningManager
    manager.block, manager.resume, manager.objective_kind = given.block, None, given.objective
    manager.cost_limit, manager.space_path = given.cost_limit, given.space
    _check_dictionaries(rest)
    rl_zoo3.train.ExperimentManager = TuningManager  # type: ignore[misc]
    with _flags("tune", ["--algo", "tdpg", "--optimize-hyperparameters", *TUNING_DEFAULTS, *rest]):
        rl_zoo3.train.train()


def _read_record(folder: Path, others: Sequence[str]) -> dict[str, Any]:
    """Return how a training was begun that is to be resumed; ``others`` are the flags beside ``--resume``."""
    if not (folder / RECORD).exists():
        raise ValueError(f"--resume {folder} is no folder of a training: it has no {RECORD}")
    record: dict[str, Any] = json.loads((folder / RECORD).read_text())
    if others and list(others) != record["arguments"]:
        raise ValueError(
            f"{folder} was begun with `{' '.join(record['arguments'])}`, not with `{' '.join(others)}`: give --resume "
            "alone, or train anew without it"
        )
    if record["algo"] != "tdpg":
        raise ValueError(f"--resume is for tdpg; a training of {record['algo']} goes on with -i and a saved model")
    if not (folder / CHECKPOINT).exists():
        raise ValueError(f"--resume {folder} has no {CHECKPOINT}: its training is finished, or had hardly begun")
    return record


def _enjoy(arguments: list[str]) -> None:
    import rl_zoo3.enjoy

    with _flags("enjoy", [*_playing(arguments), *arguments]):
        rl_zoo3.enjoy.enjoy()


def _record_video(arguments: list[str]) -> None:
    with _flags("record-video", [*_playing(arguments), *arguments]):
        runpy.run_module("rl_zoo3.record_video", run_name="__main__")


def _playing(arguments: list[str]) -> list[str]:
    """Return flags for watching a policy: it lies where ``train`` puts it, and TDPG's acts as it was trained."""
    reader = _parser("")
    reader.add_argument("--algo", default="tdpg")
    reader.add_argument("--deterministic", action="store_true")
    given, _ = reader.parse_known_args(arguments)
    _check_dictionaries(arguments)
    is_stochastic = given.algo == "tdpg" and not given.deterministic
    return ["--algo", "tdpg", "-f", "logs", *(["--stochastic"] if is_stochastic else [])]


def _plot(arguments: list[str]) -> None:
    import matplotlib.pyplot as plt
    import rl_zoo3.plots

    plots = {
        "train": rl_zoo3.plots.plot_train,
        "from-file": rl_zoo3.plots.plot_from_file,
        "all": rl_zoo3.plots.all_plots,
    }
    ours = _parser("plot")
    ours.add_argument("--kind", choices=plots, default="train", help="which of the zoo's plots (default: train)")
    ours.add_argument("--save", type=Path, metavar="FILE", help="write the figure there instead of showing it")
    if _wants_help(arguments):
        ours.print_help()
        print("\nand all flags of rl-zoo3:\n")
    given, rest = ours.parse_known_args(arguments)
    defaults = ["-a", "tdpg", "-f", "logs"] if given.kind == "train" else []

    def save() -> None:
        given.save.parent.mkdir(parents=True, exist_ok=True)
        plt.savefig(given.save, dpi=150)
        print(f"the figure is in {given.save}")

    show = plt.show if given.save is None else save
    with _flags("plot", [*defaults, *rest]), _replaced(plt, "show", show):
        plots[given.kind]()


PROGRAMS: Mapping[str, Callable[[list[str]], None]] = {
    "train": _train,
    "tune": _tune,
    "enjoy": _enjoy,
    "record-video": _record_video,
    "plot": _plot,
}


def _parser(program: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(f"sb3-tdpg {program}", add_help=False, allow_abbrev=False)


def _wants_help(arguments: Sequence[str]) -> bool:
    return "-h" in arguments or "--help" in arguments


def _check_dictionaries(arguments: Sequence[str]) -> None:
    """Refuse a value that is no Python, which the zoo reads it as: a string without quotes, mostly."""
    reader = _parser("")
    for flags in (("--env-kwargs",), ("--eval-env-kwargs",), ("-params", "--hyperparams")):
        reader.add_argument(*flags, nargs="+", action="extend", default=[], dest=flags[0].strip("-"))
    given, _ = reader.parse_known_args(arguments)
    for texts in vars(given).values():
        for text in texts:
            key, colon, value = text.partition(":")
            try:
                if not colon:
                    raise SyntaxError
                StoreDict([], "pairs")(reader, argparse.Namespace(), [text])
            except (NameError, SyntaxError) as e:
                raise ValueError(
                    f"{text} must be a key, a colon and a value in Python, a text in quotes: {key}:\"'{value}'\""
                ) from e


@contextlib.contextmanager
def _flags(program: str, arguments: Sequence[str]) -> Iterator[None]:
    """Let a program that reads ``sys.argv`` find these flags there, and tell in one line which it does not know."""

    def refuse(parser: argparse.ArgumentParser, message: str) -> None:
        raise ValueError(f"{message} (sb3-tdpg {program} --help lists all flags)")

    with (
        _replaced(sys, "argv", [f"sb3-tdpg {program}", *arguments]),
        _replaced(argparse.ArgumentParser, "error", refuse),
    ):
        yield


@contextlib.contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)
