"""Log a confidence interval of the information during training."""

import warnings

import numpy as np

from sb3_tdpg.callbacks import TDPGCallback
from sb3_tdpg.evaluation.interval import InformationInterval, component_estimates, information_interval, min_episodes
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.problem import read_problem


class InformationCallback(TDPGCallback):
    """
    Log a 95 % confidence interval of the information, in addition to the estimate that the policy is trained with.

    The interval is computed from the epoch's rollouts, which were made with the current policy. The callback also
    works without the penalty and does not change the training. The keys ``mi/lower`` and ``mi/upper`` are the limits
    summed over time. The keys ``mi/lower_t00``, ``mi/upper_t00``, ... are the limits of each time step (TensorBoard
    only). The keys ``mi/knows_d``, ... are estimated lower bounds on the information about each component of the state,
    averaged over the time steps at which the component varies. The name of a component is that in the environment's
    ``state_names``, without the unit, or ``x0``, ``x1``, ... The console does not show long keys.

    If the time steps share their weights, the interval uses one random step of each episode, since the steps of an
    episode are not independent. Every episode then has the same weight. The sums over time are the limits of this
    sample times the mean number of steps of an episode, and the only keys of a time step are those with ``t00``.

    An epoch with too few episodes is skipped with a warning.

    :param eval_freq: Number of epochs from one interval to the next, beginning with the first epoch.
    :raises ValueError: if ``eval_freq`` is below 1.
    """

    def __init__(self, eval_freq: int = 10) -> None:
        super().__init__()
        if eval_freq < 1:
            raise ValueError(f"eval_freq={eval_freq} must be at least 1 (epochs)")
        self.eval_freq = eval_freq
        self.interval: InformationInterval | None = None  # the latest

    def _on_rollout_end(self) -> None:
        model = self.tdpg
        if model.epoch % self.eval_freq != 0:
            return
        batch = model.rollout_buffer.episode_batch().information_batch()
        n_episodes, needed = batch.trvs.shape[1], min_episodes(model.policy.trv_dim)
        if n_episodes < needed:
            warnings.warn(
                f"no interval of the information: the epoch has {n_episodes} episodes, and {model.policy.trv_dim} TRVs "
                f"need {needed}; give a larger epoch_steps, or n_episodes={needed}",
                stacklevel=2,
            )
            return
        if model.pools_information:
            lengths = batch.living.sum(0).cpu().numpy()
            t = (np.random.default_rng(model.epoch).random(n_episodes) * lengths).astype(int)
            batch = InformationBatch(*(x[t, np.arange(n_episodes)][None] for x in batch[:4]))
        self.interval = information_interval(batch, seed=model.epoch)
        # As for mi/total, the values are sums over an episode, even if its steps share one estimate.
        n_steps = model.rollout_buffer.mean_length if model.pools_information else 1.0
        for limit, total in zip(("lower", "upper"), self.interval.total, strict=True):
            self.logger.record(f"mi/{limit}", total * n_steps)
            for t, value in enumerate(getattr(self.interval, limit).tolist()):
                if np.isfinite(value):
                    self.logger.record(f"mi/{limit}_t{t:02d}", value, exclude=("stdout", "log", "json", "csv"))
        estimates, _ = component_estimates(batch, seed=model.epoch)
        for name, values in zip(read_problem(self.training_env).state_names, estimates.T, strict=True):
            if np.isfinite(values).any():
                key = f"mi/knows_{name.split(' (')[0]}"
                # The console truncates longer keys, and two keys that become equal would stop the training.
                exclude = ("stdout", "log") if len(key) > 36 else ()
                self.logger.record(key, float(np.nanmean(values.clip(min=0))), exclude=exclude)
