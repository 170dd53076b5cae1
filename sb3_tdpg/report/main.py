"""Make a report: check, run what is missing, aggregate, draw, write."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from tqdm import tqdm

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import check_same_config, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import information_report, save_figure
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.information import ESTIMATES
from sb3_tdpg.paper.common import how_made
from sb3_tdpg.report.figures import (
    comparison_figure,
    degradation_curves,
    own_rows_figure,
    shows_images,
    vector_examples,
)
from sb3_tdpg.report.html import to_html
from sb3_tdpg.report.models import Source, check_registered, fingerprint, load_all
from sb3_tdpg.report.numbers import Numbers, make_numbers
from sb3_tdpg.report.page import Knowledge, Page, write_page
from sb3_tdpg.report.records import Plan, complete_rows
from sb3_tdpg.report.rows import Row, default_env_kwargs, make_rows
from sb3_tdpg.robustness import perturbation_gallery
from sb3_tdpg.robustness.scale import default_scale
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import make_episodes_env

N_EPISODES = {"image": 100, "vector": 500}
N_INFORMATION = 500  # episodes
DPI = 110


def robustness_report(
    models: Mapping[str, Any],
    env_id: str,
    *,
    out: str | Path,
    env_kwargs: Mapping[str, Any] | None = None,
    perturbations: str | Sequence[str] | None = None,
    severities: Sequence[int] = (1, 2, 3, 4, 5),
    scenarios: Sequence[Scenario] | None = None,
    n_episodes: int | None = None,
    seed: int = 0,
    deterministic: bool = False,
    jobs: int = 1,
    progress_bar: bool = True,
) -> str:
    """
    Run every model under every perturbation, and write a page that tells which method is more robust, and where.

    ``out`` then holds ``report.md`` and ``report.html`` (one file, nothing to be fetched), ``figures/``,
    ``episodes.csv.xz`` (every episode), ``levels.csv``, ``perturbations.csv`` and ``comparisons.csv`` (the numbers of
    the page, see :class:`~sb3_tdpg.report.numbers.Numbers`), ``config.json`` (settings, versions, commit) and
    ``rows/``, by which an interrupted call goes on. A later call may name other perturbations or severities: what has
    been run is not run again.

    :param models: By method, a model or several: those of its training seeds. Files (:class:`~pathlib.Path` or text) or
        models of TDPG, Stable-Baselines3 or sb3-contrib. The others are compared with the first method.
    :param env_id: A registered id, also in the ``module:id`` form.
    :param out: Folder of the results.
    :param env_kwargs: Keywords for the environment of all rows. (Of ``BallCatch-v0`` images are drawn by its fast
        renderer unless they say otherwise.)
    :param perturbations: Of the sensor and of the scene; default: all that apply.
    :param severities: Which of the five.
    :param scenarios: Rows of the environment's own; default: those of the paper's table, if it is in one.
    :param n_episodes: Of each model in each row; default: 100 with images, 500 with vectors.
    :param seed: Of environments, policies, perturbations and bootstrap.
    :param deterministic: Act without noise.
    :param jobs: Processes, for models that are files.
    :param progress_bar: Show progress on stderr.
    :return: the page, as Markdown
    :raises ValueError: if something does not fit, or the folder holds another report; nothing has been run by then.
    :raises ImportError: without the extra ``plots``.
    """
    _import_extra()
    out = Path(out)
    perturbations = [perturbations] if isinstance(perturbations, str) else perturbations
    sources = _sources(models)
    check_registered(env_id)
    kwargs = default_env_kwargs(env_id, env_kwargs)
    _check_whole(n_episodes=n_episodes, seed=seed, jobs=jobs)
    if jobs > 1 and not all(isinstance(source, Path) for of_method in sources.values() for source in of_method):
        raise ValueError(f"jobs={jobs} is for models that are files; those in memory are run by this process: jobs=1")
    space, horizon, scale = _look_at(env_id, kwargs)
    rows = make_rows(
        env_id, kwargs, space, horizon, perturbations=perturbations, severities=severities, scenarios=scenarios
    )
    loaded = load_all(sources, env_id, kwargs)
    _check_fit(loaded, rows)
    n_episodes = n_episodes or N_EPISODES["image" if shows_images(space) else "vector"]
    plan = Plan(env_id, kwargs, sources, n_episodes, seed, deterministic, scale)
    fingerprints = {label: [fingerprint(model) for model in of_method] for label, of_method in loaded.items()}
    _check_different(fingerprints, sources)
    config = dict(
        env_id=env_id,
        env_kwargs=kwargs,
        n_episodes=n_episodes,
        seed=seed,
        deterministic=deterministic,
        scale=scale,
        models=fingerprints,
    )
    check_same_config(out / "config.json", config, "report")
    if not (out / "config.json").exists():
        write_run_config(out / "config.json", config)

    records = complete_rows(plan, rows, loaded, out / "rows", jobs=jobs, progress_bar=progress_bar)
    numbers = make_numbers(records, seed=seed)
    names = {label: [_name(source) for source in of_method] for label, of_method in sources.items()}
    page = Page(env_id, kwargs, n_episodes, deterministic, names)
    page.severities = {
        row.perturbation: [each for each in rows if each.perturbation == row.perturbation]
        for row in rows
        if row.kind in ("sensor", "scene")
    }
    page.figures = _draw(numbers, plan, rows, loaded, space, out)
    page.knowledge = _measure_all(plan, rows[0], loaded, out, progress_bar)
    how = provenance()
    page.made = how_made(how["command"], how, [])
    write_frame_atomically(records, out / "episodes.csv.xz")
    for name, frame in (("levels", numbers.levels), ("perturbations", numbers.groups)):
        write_frame_atomically(frame, out / f"{name}.csv")
    write_frame_atomically(numbers.comparisons, out / "comparisons.csv")
    text = write_page(numbers, page)
    write_atomically(out / "report.md", text)
    write_atomically(out / "report.html", to_html(text, out, f"Robustness in {env_id}"))
    return text


def _sources(models: Mapping[str, Any]) -> dict[str, list[Source]]:
    """Make lists, and paths of texts."""
    if not isinstance(models, Mapping):
        raise ValueError(
            f"models={models!r} must be a dictionary of models by method, for instance "
            "{'PG': [pg_0, pg_1], 'TDPG': [tdpg_0, tdpg_1]}"
        )
    if not models:
        raise ValueError("models is empty: give at least one, for instance {'TDPG': ['runs/tdpg-seed0/model.zip']}")
    sources = {}
    for label, of_method in models.items():
        several = list(of_method) if isinstance(of_method, (list, tuple)) else [of_method]
        if not several:
            raise ValueError(f"models[{label!r}] is empty: give at least one model")
        sources[str(label)] = [Path(each) if isinstance(each, str) else each for each in several]
        for each in sources[str(label)]:
            if not isinstance(each, Path) and not hasattr(each, "get_vec_normalize_env"):
                raise ValueError(f"models[{label!r}] has {each!r}: expected a file, or a Stable-Baselines3 model")
    return sources


def _check_whole(*, n_episodes: int | None, seed: int, jobs: int) -> None:
    for name, value, least in (("n_episodes", n_episodes, 1), ("seed", seed, 0), ("jobs", jobs, 1)):
        if value is not None and (not isinstance(value, (int, np.integer)) or value < least):
            raise ValueError(f"{name}={value!r} must be an integer of at least {least}")


def _look_at(env_id: str, env_kwargs: Mapping[str, Any]) -> tuple[spaces.Space, int | None, np.ndarray | None]:
    """Return the observation space, the horizon and the scale of the components of an environment."""
    try:
        env = make_episodes_env(env_id, 8, env_kwargs=env_kwargs, use_processes=False)
    except Exception as e:
        raise ValueError(f"{env_id} cannot be made with {dict(env_kwargs)}: {e}") from e
    with contextlib.closing(env):
        horizon = env.get_attr("horizon", [0])[0] if env.has_attr("horizon") else None
        return env.observation_space, horizon, default_scale(env.observation_space, env)


def _check_fit(models: Mapping[str, Sequence[Any]], rows: Sequence[Row]) -> None:
    for label, of_method in models.items():
        named = {f"{label} {number}" if len(of_method) > 1 else label: each for number, each in enumerate(of_method)}
        check_models_fit(named, [rows[0].scenario])
    label, (first, *_) = next(iter(models.items()))
    check_models_fit({label: first}, [row.scenario for row in rows[1:] if row.kind in ("own", "scene")])


def _check_different(fingerprints: Mapping[str, Sequence[str]], sources: Mapping[str, Sequence[Source]]) -> None:
    """Refuse a policy that is there twice: it is one training seed, and would make intervals too narrow."""
    for label, prints in fingerprints.items():
        for number, each in enumerate(prints):
            if (before := prints.index(each)) != number:
                first, second = (_name(sources[label][i]) for i in (before, number))
                raise ValueError(
                    f"models {before} and {number} of {label!r} are the same policy ({first}, {second}): a training "
                    "seed counts once"
                )


def _firsts(models: Mapping[str, Sequence[Any]]) -> list[tuple[int, str, Any]]:
    return [(number, label, of_method[0]) for number, (label, of_method) in enumerate(models.items())]


def _name(source: Source) -> str:
    return str(source) if isinstance(source, Path) else f"{type(source).__name__} in memory"


def _draw(
    numbers: Numbers,
    plan: Plan,
    rows: Sequence[Row],
    models: Mapping[str, Sequence[Any]],
    space: spaces.Space,
    out: Path,
) -> dict[str, str]:
    """Draw what there is to draw; return the files by name."""
    figures = {}
    if numbers.perturbations:
        figures["degradation"] = degradation_curves(numbers)
    if (numbers.groups["kind"] == "own").any():
        figures["own_rows"] = own_rows_figure(numbers)
    if not numbers.comparisons.empty and numbers.comparisons["p_cost"].notna().any():
        figures["comparison"] = comparison_figure(numbers)
    of_sensor = [row for row in rows if row.kind == "sensor"]
    if shows_images(space) and numbers.perturbations:
        figures["examples"] = perturbation_gallery(
            plan.env_id, numbers.perturbations, env_kwargs=plan.env_kwargs, seed=plan.seed
        )
    elif of_sensor:
        first = next(iter(models.values()))[0]
        figures["examples"] = vector_examples(plan, of_sensor, first)
    return {name: _save(figure, out, name) for name, figure in figures.items()}


def _save(figure: Any, out: Path, name: str) -> str:
    path = f"figures/{name}.png"
    save_figure(figure, out / path, dpi=DPI)
    return path


def _measure_all(
    plan: Plan, row: Row, models: Mapping[str, Sequence[Any]], out: Path, progress_bar: bool
) -> list[Knowledge]:
    """Tell what the first model of each method knows of the state: a minute for each where episodes are long."""
    firsts = _firsts(models)
    total = len(ESTIMATES) * sum(isinstance(model, TDPG) for _, _, model in firsts)
    known = []
    with threads(1), tqdm(total=total, unit="estimate", disable=not progress_bar or not total) as progress:
        for number, label, model in firsts:
            progress.set_postfix_str(f"information, {label}")
            known.append(_measure(plan, row, number, label, model, out, progress.update))
    return known


def _measure(
    plan: Plan, row: Row, number: int, label: str, model: Any, out: Path, at_end: Callable[[], Any]
) -> Knowledge:
    if not isinstance(model, TDPG):
        return Knowledge(label, f"not measured: {type(model).__name__} has no task-relevant variables.")
    env = scenario_env(row.scenario, model, n_episodes=N_INFORMATION)
    try:
        with contextlib.closing(env):
            report = information_report(model, env, N_INFORMATION, plan.seed, at_end=at_end)
        figures = [_save(figure, out, f"information-{number}-{name}") for name, figure in report.figures().items()]
    except ValueError as e:  # a state that never varies, say: the rows are worth a page without it
        return Knowledge(label, f"not measured: {e}.")
    lower, upper = report.interval.total
    trust = "all checks passed" if report.badge.passed else "**not to be trusted**: a check failed"
    text = f"{lower:.2f} to {upper:.2f} nat about the state, summed over an episode's time steps ({trust})."
    if n_left_out := report.interval.n_left_out:
        text += f" **Left out**: {n_left_out} time steps to which too few of the {N_INFORMATION} episodes last."
    return Knowledge(label, text, report.badge.markdown(), figures)


def _import_extra() -> None:
    """Fail before the work, not after it."""
    try:
        import markdown_it  # noqa: F401
        import matplotlib  # noqa: F401
        import rliable  # noqa: F401
    except ImportError as e:
        raise ImportError(f"a report needs {e.name}: pip install sb3_tdpg[plots]") from e
