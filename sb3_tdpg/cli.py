"""The command line: ``python -m sb3_tdpg`` or ``sb3-tdpg``."""

from __future__ import annotations

import argparse
import os
import pkgutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: The arguments after the program's name; default: ``sys.argv``.
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
        # Commands with a results folder can be resumed.
        out = options.get("out")
        advice = "" if out is None else f"; the results so far are in {out}, and the same command continues from there"
        print(f"\ninterrupted{advice}", file=sys.stderr)
        return 130
    except (ValueError, ImportError, OSError) as e:  # bad input, a missing extra, a folder that is not writable
        print(f"error: {e}", file=sys.stderr)
        return 2
    return 0


# Commands import their modules when they run: importing torch takes seconds, and --help should not.


def _demo(out: Path, **options: Any) -> None:
    from sb3_tdpg.paper.lava import demo

    print(f"\n{demo(out, **options)}\n\nresults are in {out}")


class Experiment(NamedTuple):
    """
    A command ``reproduce``.

    :param function: Its name, below ``sb3_tdpg.paper``.
    :param folder: Default folder for the results.
    :param arguments: Fixed arguments of the function.
    :param flags: Flags that not all experiments have.
    """

    function: str
    folder: str
    arguments: dict[str, str] = {}
    flags: tuple[str, ...] = ()


EXPERIMENTS = {
    "lava": Experiment("lava:reproduce_lava", "lava_reproduction", flags=("n_paper_seeds",)),
    "ball": Experiment("ball:reproduce_ball", "ball_catch", flags=("n_paper_seeds", "controls")),
    "ball-varying": Experiment(
        "ball:reproduce_ball", "ball_catch_varying", dict(launch="varying"), ("n_paper_seeds", "controls")
    ),
    "grasp": Experiment("grasp:reproduce_grasp", "panda_grasp"),
    "grasp-camera": Experiment("grasp:reproduce_grasp", "panda_grasp_camera", dict(camera="varying")),
    "baselines": Experiment("baselines:reproduce_baselines", "baselines", flags=("n_ball_seeds", "n_grasp_seeds")),
}


def _reproduce(out: Path | None, experiment: str, **options: Any) -> None:
    chosen = EXPERIMENTS[experiment]
    given = {name: value for name, value in options.items() if value is not None}
    for name in ("controls", "n_paper_seeds", "n_ball_seeds", "n_grasp_seeds"):
        if name in given and name not in chosen.flags:
            flag = "--no-controls" if name == "controls" else f"--{name.replace('_', '-')}"
            others = " and ".join(other for other in EXPERIMENTS if name in EXPERIMENTS[other].flags)
            raise ValueError(f"{flag} is for {others}, not for {experiment}")
    out = out or Path("results", chosen.folder)
    text = pkgutil.resolve_name(f"sb3_tdpg.paper.{chosen.function}")(out, **chosen.arguments, **given)
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
            f"certify has declared shifts for Lava-v0 only, not for {env}: declare your own in Python, see "
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
    print(f"the report is {out / 'report.html'} (Markdown: {out / 'report.md'})")


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


# rl-zoo3's programs parse their own flags.
ZOO_PROGRAMS = {
    "train": "train an agent from a block of hyperparameters",
    "tune": "tune hyperparameters with Optuna",
    "record-video": "record a video of a trained agent",
    "plot": "plot training logs",
}


def _is_for_the_zoo(arguments: Sequence[str]) -> bool:
    """Whether to call a program of rl-zoo3; its ``enjoy`` takes no file."""
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

    def command(name: str, text: str) -> Callable[..., Any]:
        return commands.add_parser(name, help=text).add_argument

    add = command("demo", "train PG and TDPG on the lava problem and compare them")
    add("--out", type=Path, default=Path("results/lava"), help="folder for the results")
    add("--reading", choices=("table", "text"), default="table", help="cost definition: of the paper's table or text")
    add("--seed", type=int, default=0)
    _add_sizes(add)

    add = command("reproduce", "reproduce an experiment of the paper with many seeds")
    add("experiment", choices=tuple(EXPERIMENTS))
    add("--out", type=Path, help="folder for the results (default: one in results/ for each experiment)")
    add("--publish", type=Path, help="copy everything except the runs to this folder")
    add("--n-seeds", type=_positive, help="training seeds of each method (default: lava 10, others 5)")
    add("--n-paper-seeds", type=_positive, help="training seeds of the paper's own settings (default: lava 3, ball 1)")
    add("--n-ball-seeds", type=int, help="baselines: training seeds on ball catching (0: none); --n-seeds: on lava")
    add("--n-grasp-seeds", type=int, help="baselines: training seeds on grasping (0: none; default: 1)")
    add(
        "--no-controls", action="store_false", dest="controls", default=None,
        help="ball: train PG and TDPG without the ablations; a later call without this flag adds them",
    )  # fmt: skip
    _add_jobs(add)
    _add_sizes(add)

    for program, text in ZOO_PROGRAMS.items():
        commands.add_parser(program, help=f"rl-zoo3: {text}", add_help=False)

    add = command(
        "enjoy", "run a saved model, print the cost of its episodes, record a video; without a file: rl-zoo3's enjoy"
    )
    add("model", type=Path, help="the .zip file from model.save()")
    _add_env(add)
    add("--seed", type=int, default=0)
    add("--n-episodes", type=_positive, default=1)
    _add_deterministic(add)
    add("--record", type=Path, help="write a video to this file, .gif or .mp4")

    add = command(
        "sweep", "train with several betas and seeds, select by the paper's rule, plot cost against information"
    )
    add("--env", required=True, help="id of the environment, for instance Lava-v0")
    add("--betas", nargs="+", required=True, metavar="BETA", help="1/25 1/50 0.01 inf ...")
    add("--seeds", type=_positive, default=5, help="training seeds of each beta")
    add("--cost-limit", type=float, help="of the selection (default: minus the environment's reward_threshold)")
    add("--block", help="block of hyperparameters (default: that of the environment)")
    _add_keywords(add, "--set", "replace settings of the block: mi_estimator=logdet", dest="settings")
    add("--out", type=Path, help="folder for the results (default: results/sweep-<block>)")
    add("--storage", metavar="URL", help="share the sweep with other workers: postgresql://... or FILE.log")
    add("--study-name", help="name of the study in the storage (default: sweep-<block>)")
    add("--grace-period", type=float, default=60.0, help="seconds without a heartbeat until a worker counts as dead")
    _add_jobs(add)
    _add_sizes(add)

    add = command("certify", "compute upper bounds on the cost of lava policies under shifts of sensor and start")
    add("models", nargs="+", type=Path, help="the .zip files from model.save()")
    _add_env(add)
    add("--random-shifts", type=_positive, default=0, dest="n_random_shifts", help="in addition to the paper's shifts")
    add("--n-episodes", type=_positive, default=1_000_000, help="training episodes to record")
    add("--n-test-episodes", type=_positive, default=2000, help="episodes per random shift")
    add("--confidence", type=float, default=0.95)
    add("--cost-bound", type=float, help="clip the cost at this value (default: the cost of standing at the wall)")
    add("--seed", type=int, default=0)
    add("--out", type=Path, default=Path("results/certificate"), help="folder for the results")

    add = command("report", "run models under every perturbation, report which method is more robust, and where")
    add(
        "models", nargs="+", metavar="[LABEL=]MODEL",
        help="files from model.save(), or patterns: 'PG=runs/pg-seed*/model.zip'. The default label is the name of the "
        "file or folder without the seed. All methods are compared with the first",
    )  # fmt: skip
    _add_env(add)
    add("--perturbations", nargs="+", metavar="NAME", help="default: all that apply to the observation")
    add("--severities", nargs="+", type=int, default=(1, 2, 3, 4, 5), metavar="N", help="1 to 5")
    add(
        "--episodes", dest="n_episodes", type=_positive,
        help="per model and row (default: 100 for images, 500 for vectors)",
    )  # fmt: skip
    add("--seed", type=int, default=0)
    _add_deterministic(add)
    add("--out", type=Path, help="folder for the report (default: results/report-<env>)")
    _add_jobs(add)

    add = command("push", "publish a trained model and its card on the Hugging Face Hub")
    add("folder", type=Path, help="a folder of a run, of train, or with a model card")
    add("--repo-id", required=True, metavar="ORG/NAME", help="by convention ORG/tdpg-<environment>")
    add("--card", type=Path, help="folder for the card (default: FOLDER-hub)")
    add("--dry-run", action="store_true", help="write the card but upload nothing")
    add("--film-episodes", type=int, default=0, help="episodes in replay.mp4")

    add = command("pull", "download a model and its card from the Hugging Face Hub")
    add("repo_id", metavar="ORG/NAME")
    add("--to", type=Path, required=True, help="folder for the model")
    return parser


def _add_env(add: Callable[..., Any]) -> None:
    add("--env", required=True, help="id of the environment, for instance Lava-v0")
    _add_keywords(add, "--env-kwargs", "keywords of the environment: texture=violet_dots robot_range=[-1,1]")


def _add_keywords(add: Callable[..., Any], flag: str, text: str, **kwargs: Any) -> None:
    add(flag, nargs="+", action="extend", default=[], metavar="KEY=VALUE", help=f"{text} (values in YAML)", **kwargs)


def _add_deterministic(add: Callable[..., Any]) -> None:
    add("--deterministic", action="store_true", help="use means instead of samples: not the policy that was trained")


def _add_jobs(add: Callable[..., Any]) -> None:
    add("--jobs", type=_positive, help="processes (default: the number of cores)")


def _add_sizes(add: Callable[..., Any]) -> None:
    add("--n-timesteps", type=_positive, help="environment steps of each training")
    add("--n-eval-episodes", type=_positive, default=1000, help="episodes of each row of the table")


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return value


if __name__ == "__main__":
    sys.exit(main())
