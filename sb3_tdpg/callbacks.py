"""Callbacks that fit the critics each epoch, select a policy, write checkpoints and show progress."""

from __future__ import annotations

import json
import math
import os
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.policies import TRVPolicy

if TYPE_CHECKING:
    from sb3_tdpg.tdpg import TDPG


class TDPGCallback(BaseCallback):
    """A callback for :class:`~sb3_tdpg.TDPG`."""

    def init_callback(self, model: BaseAlgorithm) -> None:
        """Raise a ``ValueError`` before the training starts if the algorithm is not TDPG."""
        if not isinstance(model.policy, TRVPolicy):
            raise ValueError(f"{type(self).__name__} is for TDPG, but the model is a {type(model).__name__}")
        super().init_callback(model)

    @property
    def tdpg(self) -> TDPG:
        """The model."""
        return cast("TDPG", self.model)

    def _on_step(self) -> bool:
        return True


class MINECallback(TDPGCallback):
    """
    Fit the mutual-information critics to the rollouts of each epoch (lines 3 to 5 of Algorithm 2).

    :class:`~sb3_tdpg.TDPG` adds this callback before the user's callbacks, which can then read the current
    ``model.information``. A MINECallback in the user's list replaces the one that TDPG would add. Without a penalty
    (``beta=inf``) no critic is trained, as in plain policy gradient.
    """

    def _on_training_start(self) -> None:
        model, estimator = self.tdpg, self.tdpg.estimator
        n = model.epoch_size if model.pools_information else model.epoch_size // model.horizon
        if model.needs_information and n < (needed := estimator.recommended_episodes):
            name = "epoch_steps" if model.pools_information else "n_episodes"
            warnings.warn(
                f"{name}={n} are too few for {type(estimator).__name__}, which reports information where there is "
                f"none: give {name}={needed} or more (mi_estimator='logdet' needs the fewest)",
                stacklevel=2,
            )

    def _on_rollout_end(self) -> None:
        self.tdpg.fit_critics()


class Candidate(NamedTuple):
    """The policy of one epoch, measured on its own rollouts."""

    epoch: int
    cost: float  # mean cost of the epoch's episodes
    information: float  # sum over t, nats; infinite if it was not estimated

    def __str__(self) -> str:
        known = f"information {self.information:.3g} nat" if np.isfinite(self.information) else "information unknown"
        return f"epoch {self.epoch}: cost {self.cost:.4g}, {known}"

    def to_json(self) -> str:
        """Return the candidate as JSON, with ``null`` for unknown (infinite) information."""
        return json.dumps(
            {**self._asdict(), "information": self.information if np.isfinite(self.information) else None}
        )

    @classmethod
    def from_json(cls, text: str) -> Candidate:
        """Create a candidate from the string that :meth:`to_json` returned."""
        record = json.loads(text)
        return cls(**{**record, "information": math.inf if record["information"] is None else record["information"]})


class SelectionCallback(TDPGCallback):
    """
    Keep the policy of the best epoch.

    With ``cost_limit`` alone, the best epoch follows the paper's rule: it has the lowest information among the epochs
    whose mean cost is below the limit. With ``mi_limit``, the best epoch has the lowest cost among the epochs whose
    information is below ``mi_limit``. If both limits are given, only epochs whose cost is below ``cost_limit`` count.
    If many epochs reach about 0 nats, the paper's rule picks one of them arbitrarily, whereas the second rule picks the
    one with the lowest cost.

    The policy is kept in memory; :meth:`restore` puts it back into the model. With ``save_path`` each new best policy
    is also saved. It is then not lost if the training is interrupted, and a resumed training continues the selection
    from it.

    :param cost_limit: Upper limit on the expected cost.
    :param mi_limit: Upper limit on the information in nats, summed over time.
    :param save_path: File of the selected model (``.zip``); a ``.json`` file beside it holds the epoch, cost and
        information.
    :param verbose: 1: print every new best epoch.
    :raises ValueError: if neither limit is given, ``cost_limit`` is NaN, or ``mi_limit`` is NaN or negative. It is also
        raised at the start of a training if a ``VecNormalize`` normalises the observations with statistics that still
        change (``training=True``). Let the policy normalise the observations instead (``normalize_observations``).
    """

    def __init__(
        self,
        cost_limit: float | None = None,
        mi_limit: float | None = None,
        save_path: str | os.PathLike[str] | None = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if cost_limit is None and mi_limit is None:
            raise ValueError(
                "give cost_limit (selects the lowest information below that cost), mi_limit (the lowest cost below "
                "that information), or both"
            )
        if math.isnan(cost_limit or 0.0) or not (mi_limit is None or mi_limit >= 0):
            raise ValueError(f"cost_limit={cost_limit} must not be NaN, and mi_limit={mi_limit} must be at least 0")
        self.cost_limit = cost_limit
        self.mi_limit = mi_limit
        self.save_path = None if save_path is None else _zip_path(save_path)
        self.best: Candidate | None = None
        self._best_policy: dict[str, th.Tensor] | None = None

    @property
    def criterion(self) -> Literal["lowest information", "lowest cost"]:
        """The quantity that the selection minimises."""
        return "lowest information" if self.mi_limit is None else "lowest cost"

    def _init_callback(self) -> None:
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None and normalize.norm_obs and normalize.training:
            raise ValueError(
                "SelectionCallback keeps the policy of an epoch but not the statistics of VecNormalize, which go on "
                "changing: give norm_obs=False and policy_kwargs=dict(normalize_observations=True)"
            )
        resumes = self.model.num_timesteps > 0
        # The record is written after the model. A model without a record does not count: a resumed training runs its
        # epoch again.
        saved = self.save_path is not None and self.save_path.exists() and _record_path(self.save_path).exists()
        if resumes and self.best is None and saved:
            assert self.save_path is not None
            found = Candidate.from_json(_record_path(self.save_path).read_text())
            if not self._is_eligible(found):  # selected under other limits
                return
            self.best = found
            # Loading the whole model would seed all random number generators.
            _, parameters, _ = load_from_zip_file(self.save_path, device=self.model.device, load_data=False)
            self._best_policy = cast("dict[str, th.Tensor]", parameters["policy"])
        elif not resumes:
            self.best, self._best_policy = None, None
            if self.save_path is not None:  # the selection of an earlier training does not count for this one
                _record_path(self.save_path).unlink(missing_ok=True)

    def _on_rollout_end(self) -> None:
        model = self.tdpg
        cost = float(model.rollout_buffer.episode_costs.mean())
        # Unknown information must not win against known information.
        information = math.inf if model.information is None else float(model.information.clip(min=0).sum())
        candidate = Candidate(model.epoch, cost, information)
        if not self._is_eligible(candidate) or (self.best is not None and not self._is_better(candidate, self.best)):
            return
        self.best = candidate
        self._best_policy = {name: value.detach().clone() for name, value in model.policy.state_dict().items()}
        if self.verbose >= 1:
            print(f"{candidate}: new {self.criterion}")
        if self.save_path is not None:
            model.save(self.save_path)
            write_atomically(_record_path(self.save_path), candidate.to_json())

    def _is_eligible(self, candidate: Candidate) -> bool:
        under_cost = self.cost_limit is None or candidate.cost < self.cost_limit
        under_mi = self.mi_limit is None or candidate.information < self.mi_limit
        return np.isfinite(candidate.cost) and not np.isnan(candidate.information) and under_cost and under_mi

    def _is_better(self, candidate: Candidate, best: Candidate) -> bool:
        if self.mi_limit is None:
            return (candidate.information, candidate.cost) < (best.information, best.cost)
        return candidate.cost < best.cost

    def restore(self, model: TDPG) -> Candidate:
        """
        Put the selected policy into the model.

        :return: epoch, cost and information of the selected policy
        :raises ValueError: if no epoch met the limits.
        """
        if self.best is None or self._best_policy is None:
            raise ValueError(
                f"no epoch met the limits (cost_limit={self.cost_limit}, mi_limit={self.mi_limit}): train longer or "
                "loosen them; the model keeps its last policy"
            )
        model.policy.load_state_dict(self._best_policy)
        return self.best


class TrainingCheckpointCallback(TDPGCallback):
    """
    Write a file from which a killed training continues exactly as if it had not been killed.

    Every ``save_freq`` epochs, before the rollouts, this callback saves the model with the state of all random number
    generators. It also resets the environments, so that only their generators have to be saved. An older file is
    replaced only when the new one is complete. To continue::

        model = TDPG.load("checkpoint.zip", env=env)
        model.learn(model.remaining_timesteps, reset_num_timesteps=False, callback=TrainingCheckpointCallback(...))

    Environments must take their randomness from ``np_random``, as Gymnasium requires.

    :param save_path: Path of the file (``.zip``).
    :param save_freq: Number of epochs between checkpoints.
    :param verbose: 1: print each checkpoint.
    """

    def __init__(self, save_path: str | os.PathLike[str], save_freq: int = 10, verbose: int = 0) -> None:
        super().__init__(verbose)
        if save_freq < 1:
            raise ValueError(f"save_freq={save_freq} must be at least 1 (epochs)")
        self.save_path = _zip_path(save_path)
        self.save_freq = save_freq

    def _on_rollout_start(self) -> None:
        if self.tdpg.epoch % self.save_freq == 0:
            self.tdpg.save_checkpoint(self.save_path)
            if self.verbose >= 1:
                print(f"epoch {self.tdpg.epoch}: checkpoint {self.save_path}")


class TDPGProgressBar(ProgressBarCallback):
    """
    SB3's progress bar with the epoch's cost and information, and the failure rate if episodes report success.

    If the output is neither a terminal nor a notebook, a bar would appear only at the end. So a line is printed
    instead, after an epoch and at most every 30 seconds.
    """

    SECONDS = 30.0

    _open: ClassVar[list[TDPGProgressBar]] = []

    def _on_training_start(self) -> None:
        from rich import get_console

        super()._on_training_start()
        self._open.append(self)
        self._started = time.monotonic()
        console = get_console()
        self._next_line = math.inf if console.is_terminal or console.is_jupyter else 0.0

    @classmethod
    def close(cls) -> None:
        """Close the bar when the training ends or is interrupted; otherwise the terminal's cursor stays hidden."""
        while cls._open:
            cls._open.pop().pbar.close()

    def _on_rollout_end(self) -> None:
        model = cast("TDPG", self.model)
        shown = f"cost {model.rollout_buffer.episode_costs.mean():.2f}"
        if successes := model.ep_success_buffer:  # of the last stats_window_size episodes
            shown += f", {1 - sum(successes) / len(successes):.0%} failures"
        if model.information is not None:
            shown += f", {model.information.sum():.2f} nat"
        self.pbar.set_description(shown, refresh=False)  # tqdm.rich shows no postfix
        if (now := time.monotonic()) >= self._next_line:
            self._next_line = now + self.SECONDS
            total = model.num_timesteps + model.remaining_timesteps
            print(f"{now - self._started:.0f} s: {model.num_timesteps:,} of {total:,} steps, {shown}", flush=True)


def _zip_path(path: str | os.PathLike[str]) -> Path:
    """Append ``.zip`` unless the path ends in it; a dot in the name (``beta_0.013``) does not count as a suffix."""
    path = Path(path)
    return path if path.suffix == ".zip" else path.with_name(path.name + ".zip")


def _record_path(path: Path) -> Path:
    return path.with_suffix(".json")
