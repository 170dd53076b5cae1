"""The command line: ``python -m sb3_tdpg`` or ``sb3-tdpg``."""

import argparse
import contextlib
import inspect
import os
import pkgutil
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml

from sb3_tdpg.common.files import kept_by_this_process
from sb3_tdpg.common.trust import refuse_links, say_what_is_trusted


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command (default: from ``sys.argv``); return its exit code: 0 success, 2 bad input, 130 interrupted."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if _is_for_the_zoo(arguments):
        command: Callable[..., None] = _zoo
        options: dict[str, Any] = dict(program=arguments[0], arguments=arguments[1:])
    else:
        options = vars(_make_parser().parse_args(arguments))
        command = options.pop("command")
    try:
        command(**options)
    except KeyboardInterrupt:
        out = options.get("out") if command in (_demo, _reproduce, _frontier, _report, _rerun) else None
        advice = "" if out is None else f"; the results so far are in {out}, and the same command continues from there"
        print(f"\ninterrupted{advice}", file=sys.stderr)
        return 130
    except (ValueError, ImportError, OSError) as e:  # bad input, a missing extra, a folder that is not writable
        print(f"error: {e}", file=sys.stderr)
        return 2
    return 0


# Commands import their modules when they run, because importing torch takes seconds and --help must be fast.


def _demo(out: Path, **options: Any) -> None:
    from sb3_tdpg.paper.lava_tables import demo

    _print_results(out, lambda: demo(out, **options))


def _print_results(out: Path, make: Callable[[], str]) -> None:
    """Print the summary that a function writes to a folder, which is locked meanwhile."""
    with kept_by_this_process(out):
        text = make()
    print(f"\n{text}\n\nresults are in {out}")


# The experiments of ``reproduce``: function in ``sb3_tdpg.paper``, default folder in results/, fixed arguments.
EXPERIMENTS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "lava": ("lava_tables:reproduce_lava", "lava_reproduction", {}),
    "ball": ("ball:reproduce_ball", "ball_catch", {}),
    "ball-paper": ("ball_paper:reproduce_ball_paper", "ball_catch_paper", {}),
    "ball-varying": ("ball:reproduce_ball", "ball_catch_varying", dict(launch="varying")),
    "grasp": ("grasp:reproduce_grasp", "panda_grasp", {}),
    "grasp-camera": ("grasp:reproduce_grasp", "panda_grasp_camera", dict(camera="varying")),
    "pays": ("pays:reproduce_pays", "pays", {}),
    "pays-cue": ("pays:reproduce_pays", "pays_cue", dict(problems=("cue",))),
    "panda-squeeze": ("pays:reproduce_pays", "panda_squeeze", dict(problems=("panda",))),
}
# Flags that only some of these functions take.
SPECIAL_FLAGS = {"controls": "--no-controls", "n_paper_seeds": "--n-paper-seeds"}


def _reproduce(out: Path | None, experiment: str, **options: Any) -> None:
    name, folder, arguments = EXPERIMENTS[experiment]
    function = pkgutil.resolve_name(f"sb3_tdpg.paper.{name}")
    given = {name: value for name, value in options.items() if value is not None}
    for option in SPECIAL_FLAGS.keys() & given.keys() - inspect.signature(function).parameters.keys():
        raise ValueError(f"{experiment} has no {SPECIAL_FLAGS[option]}: leave it out")
    out = out or Path("results", folder)
    _print_results(out, lambda: function(out, **arguments, **given))


def _rerun(config: Path, out: Path) -> None:
    from sb3_tdpg.experiments.rerun import rerun

    print(f"results are in {rerun(config, out)}")


def _enjoy(model: Path, env: str, env_kwargs: Sequence[str], **options: Any) -> None:
    from sb3_tdpg.evaluation.enjoy import enjoy

    say_what_is_trusted(model)
    enjoy(model, env, parse_keywords(env_kwargs), **options)
    if options["record"] is not None:
        print(f"the video is {options['record']}")


def _export(model: Path, out: Path | None, format: str | None) -> None:
    from sb3_tdpg.deployment.export import export_model

    say_what_is_trusted(model)
    print(f"the policy's step is {export_model(model, out, format=format)}")


def _zoo(program: str, arguments: Sequence[str]) -> None:
    try:
        from sb3_tdpg.zoo.programs import run
    except ImportError as e:
        raise ImportError(f"{program} needs rl-zoo3 ({e}): pip install 'sb3_tdpg[zoo]'") from e

    run(program, arguments)


def _frontier(env: str, seeds: int, env_kwargs: Sequence[str], settings: Sequence[str], **options: Any) -> None:
    from sb3_tdpg.experiments.frontier import frontier

    out = options.pop("out") or Path("results", f"frontier-{options['block'] or env.rpartition(':')[2]}")
    options.update(env_kwargs=parse_keywords(env_kwargs), settings=parse_keywords(settings))
    _print_results(out, lambda: frontier(env, n_seeds=seeds, out=out, **options))


def _certify(
    models: Sequence[Path], env: str, env_kwargs: Sequence[str], nuisance: str, out: Path, **options: Any
) -> None:
    from sb3_tdpg.certificates.declared import certify_nuisance

    say_what_is_trusted(*models)
    options["env_kwargs"] = parse_keywords(env_kwargs)
    try:
        declared = yaml.safe_load(nuisance)
    except yaml.YAMLError as e:
        raise ValueError(f"--nuisance {nuisance!r} is not YAML, such as '{{vector_noise: [1, 3]}}'") from e
    _print_results(out, lambda: certify_nuisance(models, env, declared, out, **options))


def _report(models: Sequence[str], env: str, env_kwargs: Sequence[str], out: Path | None, **options: Any) -> None:
    from sb3_tdpg.common.threads import usable_cores
    from sb3_tdpg.report import parse_models, robustness_report

    out = out or Path("results", f"report-{env.rpartition(':')[2]}")
    options["jobs"] = options["jobs"] or usable_cores()
    methods = parse_models(models, env)
    say_what_is_trusted(*(path for of_method in methods.values() for path in of_method))
    with kept_by_this_process(out):
        robustness_report(methods, env, env_kwargs=parse_keywords(env_kwargs), out=out, **options)
    print(f"the report is {out / 'report.html'} (Markdown: {out / 'report.md'})")


def _push(folder: Path, repo_id: str, card: Path | None, dry_run: bool) -> None:
    from sb3_tdpg.hub import push_to_hub, write_model_card

    refuse_links(folder)
    if not (folder / "README.md").exists():
        named = Path(os.path.abspath(folder))  # "." has no name
        card = card or named.with_name(f"{named.name}-hub")
        folder = write_model_card(folder, card, repo_id)
    elif card is not None:
        raise ValueError(f"{folder} has a card already (README.md): leave out --card")
    else:
        named_in_card = re.findall(r'load_from_hub\("([^"]+)"', (folder / "README.md").read_text())
        if named_in_card and repo_id not in named_in_card:
            raise ValueError(f"the card in {folder} is for {named_in_card[0]}, not for {repo_id}: write it anew")
    if not dry_run:
        print(f"{folder} is now at {push_to_hub(folder, repo_id)}")
        return
    print(f"{folder} is ready; sb3-tdpg push {folder} --repo-id {repo_id} uploads it:")
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        print(f"{path.stat().st_size:>12,}  {path.relative_to(folder)}")


def _pull(repo_id: str, to: Path) -> None:
    from sb3_tdpg.hub import pull_from_hub

    print(f"{repo_id} is in {pull_from_hub(repo_id, to)}")


def parse_keywords(texts: Sequence[str]) -> dict[str, Any]:
    """
    Parse keywords from the command line: ``["texture=violet_dots", "robot_range=[-1, 1]"]``.

    :param texts: Texts of the form ``key=value``. The value is YAML: a number, a text, true, false, null or a list.
    :raises ValueError: if a text has another form, or a key occurs twice.
    """
    keywords: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            raise ValueError(
                f"{text!r} is not a keyword or setting with a plain name: write key=value, for instance horizon=10"
            )
        if key in keywords:
            raise ValueError(f"{text!r}: {key} is given twice")
        try:
            keywords[key] = yaml.load(value, _Loader)
        except yaml.YAMLError as e:
            raise ValueError(f"{text!r}: the value must be YAML, such as a number, a text, true or a list") from e
    return keywords


class _Loader(yaml.SafeLoader):
    """A YAML loader that reads 1e-3 and inf as numbers, unlike YAML 1.1; text in quotes stays text."""


_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|inf|nan)$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+.0123456789in"))


# rl-zoo3's programs parse their own flags.
ZOO_PROGRAMS = {
    "train": "train an agent from a block of hyperparameters",
    "tune": "tune hyperparameters with Optuna",
    "record-video": "record a video of a trained agent",
    "plot": "plot training logs",
}


def _is_for_the_zoo(arguments: Sequence[str]) -> bool:
    """Return whether the arguments call a program of rl-zoo3, whose ``enjoy`` takes no file."""
    program = arguments[0] if arguments else None
    return program in ZOO_PROGRAMS or (
        program == "enjoy"
        and not any(a.endswith(".zip") for a in arguments)
        and all(a[:1] == "-" for a in arguments[1:2])
    )


def _positive(text: str) -> int:
    with contextlib.suppress(ValueError):
        if (value := int(text)) >= 1:
            return value
    raise argparse.ArgumentTypeError(f"{text} must be an integer of at least 1")


KEYWORDS: dict[str, Any] = dict(nargs="+", action="extend", default=[], metavar="KEY=VALUE")
# Flags that several commands share.
FLAGS: dict[str, dict[str, Any]] = {
    "--env": dict(required=True, help="id of the environment, for instance Lava-v0"),
    "--env-kwargs": dict(
        help="keywords of the environment: texture=violet_dots robot_range=[-1,1] (values in YAML)", **KEYWORDS
    ),
    "--seed": dict(type=int, default=0),
    "--deterministic": dict(action="store_true", help="use means instead of samples: not the policy that was trained"),
    "--jobs": dict(type=_positive, help="processes (default: the number of cores)"),
    "--n-timesteps": dict(type=_positive, help="environment steps of each training"),
}


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="sb3-tdpg", description="Task-Driven Policy Gradient for Stable-Baselines3")
    commands = parser.add_subparsers(dest="command", required=True)

    def command(function: Callable[..., None], text: str, *flags: str) -> Callable[..., Any]:
        subparser = commands.add_parser(function.__name__.lstrip("_"), help=text)
        subparser.set_defaults(command=function)
        for flag in flags:
            subparser.add_argument(flag, **FLAGS[flag])
        return subparser.add_argument

    add = command(_demo, "train PG and TDPG on the lava problem and compare them", "--seed", "--n-timesteps")
    add("--n-eval-episodes", type=_positive, default=1000, help="episodes of each row of the table")
    add("--out", type=Path, default=Path("results/lava"), help="folder for the results")
    add("--reading", choices=("table", "text"), default="table", help="cost definition: of the paper's table or text")

    add = command(_reproduce, "reproduce an experiment of the paper with many seeds", "--jobs", "--n-timesteps")
    add("--n-eval-episodes", type=_positive, help="episodes of each row of the table (default: 1000; ball: 200)")
    add("experiment", choices=tuple(EXPERIMENTS))
    add("--out", type=Path, help="folder for the results (default: one in results/ for each experiment)")
    add("--publish", type=Path, help="copy everything except the runs to this folder")
    add("--n-seeds", type=_positive, help="training seeds of each method (default: lava, ball and pays 10, others 5)")
    add("--n-paper-seeds", type=_positive, help="training seeds of the paper's own settings (default: 3)")
    text = "ball: train TDPG, PG and RecurrentPPO only; pays: leave out PPO and RecurrentPPO; a later call may add them"
    add("--no-controls", action="store_false", dest="controls", default=None, help=text)

    add = command(_rerun, "repeat the run that a config.json describes")
    add("config", type=Path, help="the config.json of a run")
    add("out", type=Path, help="folder for the new run")

    for program, text in ZOO_PROGRAMS.items():
        commands.add_parser(program, help=f"rl-zoo3: {text}", add_help=False)

    text = "run a saved model, print the cost of its episodes, record a video; without a file: rl-zoo3's enjoy"
    add = command(_enjoy, text, "--env", "--env-kwargs", "--seed", "--deterministic")
    add("model", type=Path, help="the .zip file from model.save()")
    add("--n-episodes", type=_positive, default=1)
    add("--record", type=Path, help="write a video to this file, .gif or .mp4")

    add = command(_export, "write one step of a saved TDPG policy for a robot: ONNX or TorchScript")
    add("model", type=Path, help="the .zip file from model.save()")
    add("--out", type=Path, help="the file (default: beside the model)")
    add("--format", choices=("onnx", "torchscript"), help="default: that of the file's name, or onnx")

    text = "will the bottleneck pay? trainings that keep shares of the improvement, an open loop, a figure, a verdict"
    add = command(_frontier, text, "--env", "--env-kwargs", "--jobs", "--n-timesteps")
    add("--block", help="block of hyperparameters (default: that of the environment)")
    text = "replace settings of the block: mi_estimator=logdet (values in YAML)"
    add("--set", dest="settings", help=text, **KEYWORDS)
    add("--shares", nargs="+", type=float, default=(99, 95, 90, 80), metavar="PERCENT", help="default: 99 95 90 80")
    add("--seeds", type=_positive, default=3, help="training seeds of each row (default: 3)")
    add("--n-eval-episodes", type=_positive, default=500, help="episodes of each evaluation (default: 500)")
    add("--out", type=Path, help="folder for the results (default: results/frontier-<env or block>)")

    text = "compute upper bounds on the cost of policies under random members of a declared nuisance"
    add = command(_certify, text, "--env", "--env-kwargs", "--seed")
    add("models", nargs="+", type=Path, help="the .zip files from model.save()")
    text = "the nuisance: 'auto', a name, or '{vector_noise: [1, 3], vector_bias: 2}'"
    add("--nuisance", required=True, metavar="YAML", help=text)
    add("--members", type=_positive, default=1000, dest="n_members", help="random members of the nuisance")
    add("--n-episodes", type=_positive, default=1_000_000, help="training episodes to record")
    add("--n-test-episodes", type=_positive, default=2000, help="episodes per member")
    add("--confidence", type=float, default=0.95)
    text = "clip the cost at this value (default for Lava: the cost of standing at the wall)"
    add("--cost-bound", type=float, help=text)
    add("--out", type=Path, default=Path("results/nuisance"), help="folder for the results (default: results/nuisance)")

    text = "run models under every perturbation, report which method is more robust, and where"
    add = command(_report, text, "--env", "--env-kwargs", "--seed", "--deterministic", "--jobs")
    add(
        "models", nargs="+", metavar="[LABEL=]MODEL",
        help="files from model.save(), or patterns: 'PG=runs/pg-seed*/model.zip'. The default label is the name of the "
        "file or folder without the seed. All methods are compared with the first",
    )  # fmt: skip
    add("--perturbations", nargs="+", metavar="NAME", help="default: all that apply to the observation")
    add("--severities", nargs="+", type=int, default=(1, 2, 3, 4, 5), metavar="N", help="1 to 5")
    text = "per model and row (default: as many as fit into --steps, at most 100 for images and 500 for vectors)"
    add("--episodes", dest="n_episodes", type=_positive, help=text)
    add("--steps", dest="n_steps", type=_positive, default=10_000, help="per model and row, at most (default: 10000)")
    text = "also measure the information in the TRVs, which takes long with long episodes"
    add("--information", action="store_true", help=text)
    add("--out", type=Path, help="folder for the report (default: results/report-<env>)")

    add = command(_push, "publish a trained model and its card on the Hugging Face Hub")
    add("folder", type=Path, help="a folder of a run, of train, or with a model card")
    add("--repo-id", required=True, metavar="ORG/NAME", help="by convention ORG/tdpg-<environment>")
    add("--card", type=Path, help="folder for the card (default: FOLDER-hub)")
    add("--dry-run", action="store_true", help="write the card but upload nothing")

    add = command(_pull, "download a model and its card from the Hugging Face Hub")
    add("repo_id", metavar="ORG/NAME")
    add("--to", type=Path, required=True, help="folder for the model")
    return parser
