"""The study on public tasks: our one preset, tuned blocks and a cost limit beside PPO and RecurrentPPO."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sb3_tdpg.common.processes import process_pool
from sb3_tdpg.common.threads import usable_cores
from sb3_tdpg.experiments.public.page import Records
from sb3_tdpg.experiments.public.tasks import TASKS
from sb3_tdpg.experiments.public.trainings import PRESET, TUNED, Training, complete_training, with_limit
from sb3_tdpg.hyperparams import load_hyperparams

FIRST_SEED = 200  # those below were used for tuning


def make_trainings(seeds: Sequence[int], n_eval_episodes: int = 100, n_timesteps: int | None = None) -> list[Training]:
    """List all trainings, seed by seed, so that an interrupted call has the same seeds of all methods."""
    trainings = []
    for seed in seeds:
        for listed in TASKS:
            task = replace(listed, n_timesteps=n_timesteps or listed.n_timesteps)
            methods: dict[str, dict[str, Any] | None] = {PRESET: {}, task.rival: None}
            if task.tuned is not None:
                methods[TUNED] = {**load_hyperparams(task.tuned), "n_timesteps": task.n_timesteps}
            trainings += [Training(task, name, seed, how, n_eval_episodes) for name, how in methods.items()]
    return trainings


def complete(training: Training, root: Path) -> list[Training]:
    """Complete a training, and after that of the preset the one with a limit; return what is finished."""
    complete_training(training, root)
    if training.method != PRESET:
        return [training]
    limited = with_limit(training, root)
    complete_training(limited, root)
    return [training, limited]


def reproduce_public(
    out: Path,
    *,
    n_seeds: int = 5,
    n_eval_episodes: int = 100,
    n_timesteps: int | None = None,
    jobs: int | None = None,
    publish: Path | None = None,
) -> str:
    """
    Train all methods on all tasks, and compare the returns. Finished trainings are kept: the same call continues.

    It needs the extra ``public`` of the package. Each training has one thread.

    :param out: Folder of the trainings, and of ``summary.md``, ``curves.png``, ``config.json`` and the records.
    :param n_seeds: Training seeds of each method.
    :param n_eval_episodes: Episodes of an evaluation, with and without the noise of the policy each.
    :param n_timesteps: Steps of each training; default: as the task declares.
    :param jobs: Parallel trainings; default: the number of cores.
    :param publish: Folder that gets a copy of everything but the trainings.
    :return: the summary, as Markdown
    """
    trainings = make_trainings(range(FIRST_SEED, FIRST_SEED + n_seeds), n_eval_episodes, n_timesteps)
    with tqdm(total=len(trainings), unit="training") as progress, process_pool(jobs or usable_cores()) as pool:
        tasks = [pool.submit(complete, each, out) for each in trainings]
        for task in as_completed(tasks):
            progress.set_postfix_str(task.result()[0].folder_name)
            progress.update()
    records = Records([done for task in tasks for done in task.result()], out)
    for folder in filter(None, (publish, out)):
        summary = records.write(folder, "sb3-tdpg reproduce public")
    return summary
