"""The command line: ``python -m sb3_tdpg`` or ``sb3-tdpg``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: What stands behind the program's name; default: ``sys.argv``.
    :return: exit code: 0 done, 2 bad input, 130 interrupted
    """
    parser = _make_parser()
    options = vars(parser.parse_args(arguments))
    command = options.pop("command")
    # Imported only now: torch takes seconds, and --help should not.
    from sb3_tdpg.reproduction import ball, lava

    experiment = options.pop("experiment", None)
    out = options.pop("out") or Path("results", f"{experiment.replace('-', '_')}_reproduction")
    options = {name: value for name, value in options.items() if value is not None}
    try:
        if command == "demo":
            text = lava.demo(out, **options)
        elif experiment.startswith("ball"):
            text = ball.reproduce_ball(out, launch="varying" if experiment.endswith("varying") else "fixed", **options)
        else:
            text = lava.reproduce_lava(out, **options)
    except KeyboardInterrupt:
        print(f"\ninterrupted; {out} keeps what is done, and the same command goes on from there", file=sys.stderr)
        return 130
    except ValueError as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    print(f"\n{text}\n\nresults are in {out}")
    return 0


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sb3-tdpg", description="Task-Driven Policy Gradient for Stable-Baselines3")
    commands = parser.add_subparsers(dest="command", required=True)

    demo = commands.add_parser("demo", help="train PG and TDPG on the lava problem and compare them")
    demo.add_argument("--out", type=Path, default=Path("results/lava"), help="folder for the results")
    demo.add_argument("--reading", choices=("table", "text"), default="table", help="which reading of the problem")
    demo.add_argument("--seed", type=int, default=0)
    _add_sizes(demo)

    reproduce = commands.add_parser("reproduce", help="reproduce an experiment of the paper with many seeds")
    reproduce.add_argument("experiment", choices=("lava", "ball", "ball-varying"))
    reproduce.add_argument(
        "--out", type=Path, default=None, help="folder for the results (default: results/<experiment>_reproduction)"
    )
    reproduce.add_argument("--publish", type=Path, default=None, help="copy all but the runs to this folder")
    reproduce.add_argument("--n-seeds", type=_positive, help="training seeds of each method (default: lava 10, ball 5)")
    reproduce.add_argument(
        "--n-paper-seeds", type=_positive, help="training seeds of the paper's own settings (default: lava 3, ball 1)"
    )
    reproduce.add_argument("--jobs", type=_positive, default=None, help="runs at a time (default: the number of cores)")
    _add_sizes(reproduce)
    return parser


def _add_sizes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--n-timesteps", type=_positive, default=None, help="environment steps of each training")
    parser.add_argument("--n-eval-episodes", type=_positive, default=1000, help="episodes of each row of the table")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return value


if __name__ == "__main__":
    sys.exit(main())
