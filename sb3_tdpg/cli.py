"""The command line: ``python -m sb3_tdpg`` or ``sb3-tdpg``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: What stands behind the program's name; default: ``sys.argv``.
    :return: exit code: 0 done, 2 bad input, 130 interrupted
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if _is_for_the_zoo(arguments):
        command: Callable[..., None] = _zoo
        options: dict[str, Any] = dict(program=arguments[0], arguments=arguments[1:])
    else:
        options = vars(_make_parser().parse_args(arguments))
        command = COMMANDS[options.pop("command")]
    try:
        command(**options)
    except KeyboardInterrupt:
        # A command that has a folder for its results can be resumed.
        out = options.get("out")
        advice = "" if out is None else f"; {out} keeps what is done, and the same command goes on from there"
        print(f"\ninterrupted{advice}", file=sys.stderr)
        return 130
    except (ValueError, ImportError, OSError) as e:  # a missing extra; a folder that cannot be written to
        print(f"error: {e}", file=sys.stderr)
        return 2
    return 0


# The commands import what they need when they run: torch takes seconds, and --help should not.


def _demo(out: Path, **options: Any) -> None:
    from sb3_tdpg.paper.lava import demo

    print(f"\n{demo(out, **options)}\n\nresults are in {out}")


def _reproduce(out: Path | None, experiment: str, **options: Any) -> None:
    from sb3_tdpg.paper.ball import reproduce_ball
    from sb3_tdpg.paper.baselines import reproduce_baselines
    from sb3_tdpg.paper.grasp import reproduce_grasp
    from sb3_tdpg.paper.lava import reproduce_lava

    given = {name: value for name, value in options.items() if value is not None}
    if "controls" in given and not experiment.startswith("ball"):
        raise ValueError(f"--no-controls is for ball and ball-varying: {experiment} does not do without any")
    for name in ("n_ball_seeds", "n_grasp_seeds"):
        if name in given and experiment != "baselines":
            raise ValueError(f"--{name.replace('_', '-')} is for baselines: {experiment} has --n-seeds alone")
    if "n_paper_seeds" in given and experiment == "baselines":
        raise ValueError("--n-paper-seeds is for lava and ball: the baselines are not the paper's")
    if experiment == "baselines":
        out = out or Path("results/baselines")
        text = reproduce_baselines(out, **given)
    elif experiment == "lava":
        out = out or Path("results/lava_reproduction")
        text = reproduce_lava(out, **given)
    elif experiment.startswith("grasp"):
        if "n_paper_seeds" in given:
            raise ValueError("--n-paper-seeds is for lava and ball: the paper's own settings of grasp are not trained")
        out = out or Path("results", experiment.replace("-", "_").replace("grasp", "panda_grasp"))
        text = reproduce_grasp(out, camera="varying" if experiment == "grasp-camera" else "fixed", **given)
    else:
        out = out or Path("results", experiment.replace("-", "_").replace("ball", "ball_catch"))
        text = reproduce_ball(out, launch="varying" if experiment == "ball-varying" else "fixed", **given)
    print(f"\n{text}\n\nresults are in {out}")


def _enjoy(model: Path, env: str, env_kwargs: Sequence[str], **options: Any) -> None:
    from sb3_tdpg.evaluation.enjoy import enjoy, parse_keywords

    enjoy(model, env, parse_keywords(env_kwargs), **options)


def _zoo(program: str, arguments: Sequence[str]) -> None:
    try:
        from sb3_tdpg.zoo.programs import run
    except ImportError as e:
        raise ImportError(f"{program} needs rl-zoo3 ({e}): pip install 'sb3_tdpg[zoo]'") from e

    run(program, arguments)


def _sweep(env: str, seeds: int, settings: Sequence[str], **options: Any) -> None:
    from sb3_tdpg.evaluation.enjoy import parse_keywords
    from sb3_tdpg.experiments.sweep import sweep

    out = options.pop("out") or Path("results", f"sweep-{options['block'] or env}")
    print(
        f"\n{sweep(env, n_seeds=seeds, settings=parse_keywords(settings), out=out, **options)}\n\nresults are in {out}"
    )


def _certify(models: Sequence[Path], env: str, env_kwargs: Sequence[str], out: Path, **options: Any) -> None:
    from sb3_tdpg.certificates.lava import certify_lava
    from sb3_tdpg.evaluation.enjoy import parse_keywords

    if env.rpartition(":")[2] != "Lava-v0":
        raise ValueError(
            f"certify knows the shifts of Lava-v0 only, and not of {env}: declare them in Python, see "
            "sb3_tdpg.certificates.shifts.TrainingEpisodes"
        )
    print(f"\n{certify_lava(models, out, env_kwargs=parse_keywords(env_kwargs), **options)}\n\nresults are in {out}")


def _report(models: Sequence[str], env: str, env_kwargs: Sequence[str], out: Path | None, **options: Any) -> None:
    from sb3_tdpg.common.processes import usable_cores
    from sb3_tdpg.evaluation.enjoy import parse_keywords
    from sb3_tdpg.report import parse_models, robustness_report

    out = out or Path("results", f"report-{env.rpartition(':')[2]}")
    options["jobs"] = options["jobs"] or usable_cores()
    robustness_report(parse_models(models, env), env, env_kwargs=parse_keywords(env_kwargs), out=out, **options)
    print(f"the page is {out / 'report.html'}, and {out / 'report.md'} in Markdown")


def _push(folder: Path, repo_id: str, card: Path | None, dry_run: bool, film_episodes: int) -> None:
    from sb3_tdpg.hub import push_to_hub, write_model_card

    if not (folder / "README.md").exists():
        named = Path(os.path.abspath(folder))  # "." has no name
        card = card or named.with_name(f"{named.name}-hub")
        folder = write_model_card(folder, card, repo_id, film_episodes=film_episodes)
    if not dry_run:
        print(f"{folder} is now at {push_to_hub(folder, repo_id)}")
        return
    print(f"{folder} is ready; without --dry-run it goes to https://huggingface.co/{repo_id}:")
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        print(f"{path.stat().st_size:>12,}  {path.relative_to(folder)}")


def _pull(repo_id: str, to: Path) -> None:
    from sb3_tdpg.hub import pull_from_hub

    print(f"{repo_id} is in {pull_from_hub(repo_id, to)}")


# rl-zoo3's programs read their flags themselves.
ZOO_PROGRAMS = {
    "train": "train an agent from a block of hyperparameters",
    "tune": "tune hyperparameters with Optuna",
    "record-video": "record a trained agent as a film",
    "plot": "plot what trainings have logged",
}


def _is_for_the_zoo(arguments: Sequence[str]) -> bool:
    """Whether a program of rl-zoo3 is asked for; its ``enjoy`` is the one that is given no file."""
    if not arguments:
        return False
    return arguments[0] in ZOO_PROGRAMS or (arguments[0] == "enjoy" and not any(a.endswith(".zip") for a in arguments))


COMMANDS: dict[str, Callable[..., None]] = {
    "demo": _demo,
    "reproduce": _reproduce,
    "enjoy": _enjoy,
    "sweep": _sweep,
    "certify": _certify,
    "report": _report,
    "push": _push,
    "pull": _pull,
}


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sb3-tdpg", description="Task-Driven Policy Gradient for Stable-Baselines3")
    commands = parser.add_subparsers(dest="command", required=True)

    demo = commands.add_parser("demo", help="train PG and TDPG on the lava problem and compare them")
    demo.add_argument("--out", type=Path, default=Path("results/lava"), help="folder for the results")
    demo.add_argument("--reading", choices=("table", "text"), default="table", help="which reading of the problem")
    demo.add_argument("--seed", type=int, default=0)
    _add_sizes(demo)

    reproduce = commands.add_parser("reproduce", help="reproduce an experiment of the paper with many seeds")
    reproduce.add_argument("experiment", choices=("lava", "ball", "ball-varying", "grasp", "grasp-camera", "baselines"))
    reproduce.add_argument(
        "--out", type=Path, default=None, help="folder for the results (default: one in results/ for each experiment)"
    )
    reproduce.add_argument("--publish", type=Path, default=None, help="copy all but the runs to this folder")
    reproduce.add_argument(
        "--n-seeds", type=_positive, help="training seeds of each method (default: lava 10, others 5)"
    )
    reproduce.add_argument(
        "--n-paper-seeds", type=_positive, help="training seeds of the paper's own settings (default: lava 3, ball 1)"
    )
    reproduce.add_argument(
        "--n-ball-seeds", type=int, help="baselines: training seeds on ball catching, 0: none; --n-seeds: on lava"
    )
    reproduce.add_argument(
        "--n-grasp-seeds", type=int, help="baselines: training seeds on grasping, 0: none (default: 1)"
    )
    reproduce.add_argument(
        "--no-controls", action="store_false", dest="controls", default=None,
        help="ball: only PG and TDPG; without it, a later call adds the controls",
    )  # fmt: skip
    reproduce.add_argument("--jobs", type=_positive, default=None, help="runs at a time (default: the number of cores)")
    _add_sizes(reproduce)

    for program, text in ZOO_PROGRAMS.items():
        commands.add_parser(program, help=f"rl-zoo3: {text}", add_help=False)

    enjoy = commands.add_parser(
        "enjoy",
        help="run a saved model, print what its episodes cost, record them as a film; without a file: rl-zoo3's, of a "
        "model that train has left",
    )
    enjoy.add_argument("model", type=Path, help="the .zip file that model.save() wrote")
    enjoy.add_argument("--env", required=True, help="id of the environment, for instance Lava-v0")
    enjoy.add_argument(
        "--env-kwargs", nargs="+", action="extend", default=[], metavar="KEY=VALUE",
        help="keywords of the environment, the values in YAML: texture=violet_dots robot_range=[-1,1]",
    )  # fmt: skip
    enjoy.add_argument("--seed", type=int, default=0)
    enjoy.add_argument("--n-episodes", type=_positive, default=1)
    enjoy.add_argument("--deterministic", action="store_true", help="act without noise: this is another policy")
    enjoy.add_argument("--record", type=Path, default=None, help="write a film there, .gif or .mp4")
    _add_sweep(commands)
    _add_certify(commands)
    _add_report(commands)
    _add_hub(commands)
    return parser


def _add_sweep(commands: Any) -> None:
    sweep = commands.add_parser(
        "sweep", help="train with several betas and seeds, select by the paper's rule, draw cost against information"
    )
    sweep.add_argument("--env", required=True, help="id of the environment, for instance Lava-v0")
    sweep.add_argument("--betas", nargs="+", required=True, metavar="BETA", help="1/25 1/50 0.01 inf ...")
    sweep.add_argument("--seeds", type=_positive, default=5, help="training seeds of each beta")
    sweep.add_argument("--cost-limit", type=float, default=None, help="for the selection (default: the environment's)")
    sweep.add_argument("--block", default=None, help="block of hyperparameters (default: that of the environment)")
    sweep.add_argument(
        "--set", dest="settings", nargs="+", action="extend", default=[], metavar="KEY=VALUE",
        help="settings in place of the block's, the values in YAML: mi_estimator=logdet",
    )  # fmt: skip
    sweep.add_argument("--out", type=Path, default=None, help="folder for the results (default: results/sweep-<block>)")
    sweep.add_argument(
        "--storage", default=None, metavar="URL",
        help="work at a sweep that others work at, too: postgresql://... or FILE.log",
    )  # fmt: skip
    sweep.add_argument("--study-name", default=None, help="its name there (default: sweep-<block>)")
    sweep.add_argument(
        "--grace-period", type=float, default=60.0, help="seconds without a heartbeat until a worker counts as dead"
    )
    sweep.add_argument(
        "--jobs", type=_positive, default=None, help="runs at a time (default: the number of cores; with --storage 1)"
    )
    _add_sizes(sweep)


def _add_certify(commands: Any) -> None:
    certify = commands.add_parser("certify", help="bound what saved lava policies cost when sensor and start change")
    certify.add_argument("models", nargs="+", type=Path, help="the .zip files that model.save() wrote")
    certify.add_argument("--env", required=True, help="id of the environment: Lava-v0")
    certify.add_argument(
        "--env-kwargs", nargs="+", action="extend", default=[], metavar="KEY=VALUE",
        help="keywords of the training environment, the values in YAML",
    )  # fmt: skip
    certify.add_argument(
        "--random-shifts", type=_positive, default=0, dest="n_random_shifts", help="beside the paper's shifts"
    )
    certify.add_argument("--n-episodes", type=_positive, default=1_000_000, help="recorded training episodes")
    certify.add_argument("--n-test-episodes", type=_positive, default=2000, help="episodes in each random shift")
    certify.add_argument("--confidence", type=float, default=0.95)
    certify.add_argument(
        "--cost-bound", type=float, default=None, help="clip the cost there (default: that of standing at the wall)"
    )
    certify.add_argument("--seed", type=int, default=0)
    certify.add_argument("--out", type=Path, default=Path("results/certificate"), help="folder for the results")


def _add_report(commands: Any) -> None:
    report = commands.add_parser(
        "report", help="run models under every perturbation, and write a page on which method is more robust, and where"
    )
    report.add_argument(
        "models", nargs="+", metavar="[LABEL=]MODEL",
        help="files that model.save() wrote, or patterns: 'PG=runs/pg-seed*/model.zip'; without a label a method is "
        "called as its file or folder, less the seed. The others are compared with the first",
    )  # fmt: skip
    report.add_argument("--env", required=True, help="id of the environment, for instance Lava-v0")
    report.add_argument(
        "--env-kwargs", nargs="+", action="extend", default=[], metavar="KEY=VALUE",
        help="keywords of the environment, the values in YAML",
    )  # fmt: skip
    report.add_argument("--perturbations", nargs="+", default=None, metavar="NAME", help="default: all that apply")
    report.add_argument("--severities", nargs="+", type=int, default=(1, 2, 3, 4, 5), metavar="N", help="1 to 5")
    report.add_argument(
        "--episodes", dest="n_episodes", type=_positive, default=None,
        help="of each model in each row (default: 100 with images, 500 with vectors)",
    )  # fmt: skip
    report.add_argument("--seed", type=int, default=0)
    report.add_argument("--deterministic", action="store_true", help="act without noise: this is another policy")
    report.add_argument("--out", type=Path, default=None, help="folder for the report (default: results/report-<env>)")
    report.add_argument("--jobs", type=_positive, default=None, help="processes (default: the number of cores)")


def _add_hub(commands: Any) -> None:
    push = commands.add_parser("push", help="publish a trained model and its card on the Hugging Face Hub")
    push.add_argument("folder", type=Path, help="a run's folder, one that train has left, or one with a model card")
    push.add_argument("--repo-id", required=True, metavar="ORG/NAME", help="by convention ORG/tdpg-<environment>")
    push.add_argument("--card", type=Path, default=None, help="where the card is written (default: FOLDER-hub)")
    push.add_argument("--dry-run", action="store_true", help="write the card, and upload nothing")
    push.add_argument("--film-episodes", type=int, default=0, help="episodes to show in replay.mp4")
    pull = commands.add_parser("pull", help="download a model and its card from the Hugging Face Hub")
    pull.add_argument("repo_id", metavar="ORG/NAME")
    pull.add_argument("--to", type=Path, required=True, help="folder for it")


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
