"""Make a report: check the arguments, run the missing rows, aggregate the costs, draw figures and write the page."""

import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from gymnasium import spaces
from tqdm import tqdm

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import check_same_config, how_made, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.checks import count as check_count
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import InformationReport, information_report, save_figure
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.information import ESTIMATES
from sb3_tdpg.problem import horizon_of
from sb3_tdpg.report.charts import degradation_curves, own_rows_figure
from sb3_tdpg.report.models import Source, fingerprint, load_all
from sb3_tdpg.report.numbers import Numbers, make_numbers
from sb3_tdpg.report.page import Knowledge, Page, to_html, write_page
from sb3_tdpg.report.plan import Models, Plan, complete_rows, default_episodes, missing_rows, seconds_of_a_row
from sb3_tdpg.report.rows import Row, make_rows
from sb3_tdpg.robustness import perturbation_gallery
from sb3_tdpg.robustness.registry import PERTURBATIONS
from sb3_tdpg.robustness.scale import default_scale
from sb3_tdpg.robustness.sensor import kind_of
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import make_episodes_env

N_INFORMATION = 500  # episodes
N_STEPS = 10_000  # number of steps of each model in each row
PAUSE = 4  # pause between two unfinished pages, as a multiple of the time to write one
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
    n_steps: int = N_STEPS,
    information: bool = False,
    seed: int = 0,
    deterministic: bool = False,
    jobs: int = 1,
    progress_bar: bool = True,
) -> str:
    """
    Run every model under every perturbation, and write a page that compares the robustness of the methods.

    ``out`` then contains ``report.md``, ``report.html`` (one file that includes its pictures) and the files that
    docs/guide/report.md names. A *row* of the report is the unperturbed environment, a perturbation at one severity, or
    a test row of the environment. During the run, the page is updated with the finished rows. The same call continues
    an interrupted report. A later call can have other perturbations or severities; finished rows are not run again.

    :param models: The models of each method: one model, or a list with one model for each training seed. A model is a
        file (:class:`~pathlib.Path` or text) or a model of TDPG, Stable-Baselines3 or sb3-contrib. All methods are
        compared with the first method.
    :param env_id: A registered id, or ``module:id``.
    :param out: Folder of the results.
    :param env_kwargs: Keywords of the environment in all rows.
    :param perturbations: Names of perturbations. By default, all perturbations that apply.
    :param severities: Severities from 1 to 5.
    :param scenarios: Test rows of the environment. By default, the test rows of the paper's table, if there are any.
    :param n_episodes: Number of episodes of each model in each row. By default, as many as ``n_steps`` allows, but at
        most 100 with images and 500 with vectors.
    :param n_steps: Maximum number of steps of each model in each row, from which ``n_episodes`` is computed.
    :param information: Whether to measure also the information in the TRVs of the first TDPG model of each method. With
        long episodes this takes much longer than the rest of the report.
    :param seed: Seed of environments, policies, perturbations and bootstrap.
    :param deterministic: Whether the policies act without noise.
    :param jobs: Number of processes, if all models are files.
    :param progress_bar: Whether to show progress on stderr.
    :return: The page, as Markdown.
    :raises ValueError: if an argument is wrong, or the folder contains another report; no row has been run in this
        case.
    :raises ImportError: if the extra ``plots`` is not installed.
    """
    _import_extra()
    out = Path(out)
    perturbations = [perturbations] if isinstance(perturbations, str) else perturbations
    sources = _sources(models)
    if not isinstance(env_id, str):
        raise ValueError(f"env_id={env_id!r} must be the id of an environment: gymnasium.register('Mine-v0', MyEnv)")
    kwargs = dict(env_kwargs or {})
    for name, value in dict(n_episodes=n_episodes, n_steps=n_steps, jobs=jobs).items():
        if value is not None:
            check_count(name, value)
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed={seed!r} must be an integer of at least 0")
    if jobs > 1 and not all(isinstance(source, Path) for of_method in sources.values() for source in of_method):
        raise ValueError(f"jobs={jobs} needs models that are files; models in memory run in this process: use jobs=1")
    space, action_space, horizon, scale = _look_at(env_id, kwargs)
    which: dict[str, Any] = dict(perturbations=perturbations, severities=severities, scenarios=scenarios)
    rows = make_rows(env_id, kwargs, space, horizon, action_space, **which)
    loaded = load_all(sources, env_id, kwargs)
    _check_fit(loaded, rows)
    n_episodes = n_episodes or default_episodes(kind_of(space), horizon, n_steps)
    plan = Plan(env_id, kwargs, sources, n_episodes, seed, deterministic, scale)
    names = {label: [_name(source) for source in of_method] for label, of_method in sources.items()}
    fingerprints = {label: [fingerprint(model) for model in of_method] for label, of_method in loaded.items()}
    for label, of_method in loaded.items():
        _check_different(label, of_method, fingerprints[label], names[label])
    config = {name: value for name, value in vars(plan).items() if name != "sources"} | {"models": fingerprints}
    check_same_config(out / "config.json", config, "report")
    if not (out / "config.json").exists():
        write_run_config(out / "config.json", config)

    writer = _Writer(plan, rows, names, loaded, space, out)
    if progress_bar:
        writer.say_how_long(horizon, jobs)
    records = complete_rows(
        plan, rows, loaded, out / "rows", jobs=jobs, progress_bar=progress_bar, at_row=writer.write_unfinished
    )
    text = writer.write(rows, records)
    write_frame_atomically(records, out / "episodes.csv.xz")
    if information:
        text = writer.write(rows, records, writer.measure_information(progress_bar))
    return text


@dataclass
class _Writer:
    """Write the page and its files, for all rows or for the finished rows."""

    plan: Plan
    rows: Sequence[Row]
    names: Mapping[str, Sequence[str]]
    models: Models
    space: spaces.Space
    out: Path
    how: dict[str, Any] = field(default_factory=provenance)
    not_before: float = 0.0

    def say_how_long(self, horizon: int | None, jobs: int) -> None:
        """Print an estimate of the time that the missing rows will take."""
        if not (missing := missing_rows(self.rows, self.out / "rows")):
            return
        seconds = seconds_of_a_row(self.plan, self.rows[0], self.models, horizon)
        minutes = seconds * len(missing) / min(jobs, len(missing)) / 60
        how_long = f"about {minutes:.0f} minutes" if minutes > 1.5 else f"about {60 * minutes:.0f} seconds"
        print(
            f"{len(missing)} rows of {self.plan.n_episodes} episodes of each model: {how_long} with {jobs} "
            f"process{'es' * (jobs > 1)}; the finished rows are in {self.out / 'report.html'}",
            file=sys.stderr,
        )

    def write_unfinished(self, records: Mapping[Row, pd.DataFrame]) -> None:
        """Write the page with the finished rows, unless the last page has been written only a short time ago."""
        began = time.monotonic()
        if self.rows[0] not in records or len(records) == len(self.rows) or began < self.not_before:
            return
        # A perturbation is shown only with all its severities: a mean over the mild ones alone would look too good.
        open_names = {row.perturbation for row in self.rows if row not in records and row.kind != "own"}
        rows = [row for row in self.rows if row in records and row.perturbation not in open_names]
        if len(rows) == 1:  # no perturbation is finished yet
            return
        self.write(rows, pd.concat([records[row] for row in rows], ignore_index=True))
        self.not_before = time.monotonic() + PAUSE * (time.monotonic() - began)

    def write(self, rows: Sequence[Row], records: pd.DataFrame, knowledge: Sequence[Knowledge] = ()) -> str:
        """Write the page with the given rows, and return it as Markdown."""
        # The first method must come first, because all methods are compared with it.
        records = pd.concat([records[records["model"] == label] for label in self.names], ignore_index=True)
        out, numbers = self.out, make_numbers(records, seed=self.plan.seed)
        is_finished = len(rows) == len(self.rows)
        figures = self._draw(numbers, is_finished)
        made = how_made(self.how["command"], self.how)
        page = Page(self.plan, rows, self.names, figures, knowledge, made, n_rows=len(self.rows))
        write_frame_atomically(numbers.levels, out / "levels.csv")
        write_frame_atomically(numbers.groups, out / "perturbations.csv")
        write_frame_atomically(numbers.comparisons, out / "comparisons.csv")
        text = write_page(numbers, page)
        write_atomically(out / "report.md", text)
        html = to_html(text, out, f"Robustness in {self.plan.env_id}", reload=not is_finished)
        write_atomically(out / "report.html", html)
        return text

    def _draw(self, numbers: Numbers, is_finished: bool) -> dict[str, str]:
        """Draw the figures of this report, the examples only for a finished page; return the file of each figure."""
        figures = {}
        if numbers.perturbations:
            figures["degradation"] = degradation_curves(numbers)
        if (numbers.groups["kind"] == "own").any():
            figures["own_rows"] = own_rows_figure(numbers)
        # The examples leave out changes of the timing of the kind "any", which one picture cannot show.
        shown = [name for name in numbers.perturbations if PERTURBATIONS[name].kind == "image"]
        if is_finished and shown and kind_of(self.space) == "image":
            plan = self.plan
            figures["examples"] = perturbation_gallery(plan.env_id, shown, env_kwargs=plan.env_kwargs, seed=plan.seed)
        return {name: _save(figure, self.out, name) for name, figure in figures.items()}

    def measure_information(self, progress_bar: bool) -> list[Knowledge]:
        """Measure the information in the TRVs of the first model of each method; long episodes take many minutes."""
        firsts = {label: of_method[0] for label, of_method in self.models.items()}
        total = len(ESTIMATES) * sum(isinstance(model, TDPG) for model in firsts.values())
        known = []
        with threads(1), tqdm(total=total, unit="estimate", disable=not progress_bar or not total) as progress:
            for number, (label, model) in enumerate(firsts.items()):
                progress.set_postfix_str(f"information, {label}")
                try:
                    if not isinstance(model, TDPG):
                        raise ValueError(f"{type(model).__name__} has no task-relevant variables")
                    with closing(scenario_env(self.rows[0].scenario, model, n_episodes=N_INFORMATION)) as env:
                        report = information_report(model, env, N_INFORMATION, self.plan.seed, at_end=progress.update)
                    known.append(_knowledge(label, report, self.out, f"information-{number}"))
                    if model.auto_weight is not None and (kept := model.auto_weight.kept()) is not None:
                        known[-1].text += f" By the estimate of the training, {kept}."
                except ValueError as e:  # for instance a constant state; the rest of the page is still useful
                    known.append(Knowledge(label, f"not measured: {e}."))
        return known


def _import_extra() -> None:
    """Check that the optional dependencies are installed before the work begins."""
    try:
        for name in ("jinja2", "markdown_it", "matplotlib", "rliable"):
            import_module(name)
    except ImportError as e:
        raise ImportError(f"a report needs {e.name}: pip install sb3_tdpg[plots]") from e


def _sources(models: Mapping[str, Any]) -> dict[str, list[Source]]:
    """Check the models; convert single models to lists and text to paths."""
    if not isinstance(models, Mapping) or not models:
        raise ValueError(
            f"models={models!r} must be a dictionary with at least one method, for instance "
            "{'PG': [pg_0, pg_1], 'TDPG': ['runs/tdpg-seed0/model.zip']}"
        )
    sources = {}
    for label, of_method in models.items():
        several = of_method if isinstance(of_method, (list, tuple)) else [of_method]
        if not several or not all(isinstance(x, (str, Path)) or hasattr(x, "get_vec_normalize_env") for x in several):
            raise ValueError(f"models[{label!r}]={of_method!r}: expected files, or models of Stable-Baselines3")
        sources[str(label)] = [Path(each) if isinstance(each, str) else each for each in several]
    return sources


def _name(source: Source) -> str:
    return str(source) if isinstance(source, Path) else f"{type(source).__name__} in memory"


def _look_at(env_id: str, env_kwargs: Mapping[str, Any]) -> tuple[spaces.Space, spaces.Space, int | None, Any]:
    """Return an environment's observation space, action space and horizon, and the scale of its observations."""
    try:
        env = make_episodes_env(env_id, 8, env_kwargs=env_kwargs, use_processes=False)
    except Exception as e:
        raise ValueError(f"{env_id} cannot be made with {dict(env_kwargs)}: {e}") from e
    with closing(env):
        space = env.observation_space
        return space, env.action_space, horizon_of(env), default_scale(space, env)


def _check_fit(models: Models, rows: Sequence[Row]) -> None:
    for label, of_method in models.items():
        named = {f"{label} {number}" if len(of_method) > 1 else label: each for number, each in enumerate(of_method)}
        check_models_fit(named, [rows[0].scenario])
    label, (first, *_) = next(iter(models.items()))
    check_models_fit({label: first}, [row.scenario for row in rows[1:] if row.kind == "own"])


def _check_different(label: str, models: Sequence[Any], prints: Sequence[str], names: Sequence[str]) -> None:
    """Raise an error if a policy occurs twice: if it counted as two training seeds, intervals would be too narrow."""
    kinds = sorted({type(model).__name__ for model in models})
    if len(kinds) > 1:
        raise ValueError(f"{label!r} has models of {' and '.join(kinds)}: give each a label, LABEL=FILE")
    for number, each in enumerate(prints):
        if (before := prints.index(each)) != number:
            raise ValueError(
                f"models {before} and {number} of {label!r} are the same policy ({names[before]}, {names[number]}): "
                "a training seed counts once"
            )


def _save(figure: Any, out: Path, name: str) -> str:
    path = f"figures/{name}.png"
    save_figure(figure, out / path, dpi=DPI)
    return path


def _knowledge(label: str, report: InformationReport, out: Path, prefix: str) -> Knowledge:
    figures = [_save(figure, out, f"{prefix}-{name}") for name, figure in report.figures().items()]
    lower, upper = report.interval.total
    text = f"{lower:.2f} to {upper:.2f} nat about the state, summed over the time steps of an episode."
    if n_left_out := report.interval.n_left_out:
        text += f" **Left out**: {n_left_out} time steps that too few of the {N_INFORMATION} episodes reach."
    return Knowledge(label, text, figures)
