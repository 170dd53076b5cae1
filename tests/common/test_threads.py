"""Small arrays are computed with one thread, and what was set is there again afterwards."""

from functools import partial

import pytest
import torch as th
from small_problems import tiny_tdpg, train_epochs
from stable_baselines3.common.callbacks import BaseCallback
from threadpoolctl import threadpool_info, threadpool_limits

from sb3_tdpg import TDPG
from sb3_tdpg.common.threads import threads
from sb3_tdpg.evaluation import information_interval
from sb3_tdpg.evaluation.information import state_knowledge
from sb3_tdpg.presets import DEPTH, IMAGE


def in_use():
    """Threads of torch, and of the libraries of linear algebra."""
    return th.get_num_threads(), {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two():
    """Begin with two threads, as a user who has set nothing may have."""
    before = th.get_num_threads()
    with threadpool_limits(2, user_api="blas"):
        th.set_num_threads(2)
        yield
        th.set_num_threads(before)


class Watch(BaseCallback):
    """Writes down what is in use in training."""

    def _on_training_start(self):
        self.seen = in_use()

    def _on_step(self):
        return True


def test_both_kinds_of_threads_are_limited_and_given_back_also_after_an_error():
    before = in_use()
    assert before == (2, {2})
    with pytest.raises(RuntimeError), threads(1):
        assert in_use() == (1, {1})
        raise RuntimeError
    assert in_use() == before
    with threads(None):
        assert in_use() == before


@pytest.mark.parametrize("n_threads, expected", [(None, (1, {1})), (2, (2, {2}))])
def test_training_on_vectors_takes_one_thread_unless_told_otherwise(n_threads, expected, tmp_path):
    watch = Watch()
    model = train_epochs(tiny_tdpg(n_threads=n_threads), 1, callback=watch)
    assert watch.seen == expected
    assert in_use() == (2, {2})
    model.save(tmp_path / "model")
    assert TDPG.load(tmp_path / "model").n_threads == model.n_threads == min(expected[1])
    assert (IMAGE.n_threads, DEPTH.n_threads) == (None, None)  # what is set


class Asked(Exception):
    """Raised by what is asked for its samples."""


class Samples:
    """Asked for anything, they tell in what is in use."""

    def __getattr__(self, name):
        raise Asked(*in_use())


@pytest.mark.parametrize("estimate", [information_interval, partial(state_knowledge, names=["a"])])
def test_what_is_measured_after_the_training_takes_one_thread(estimate):
    with pytest.raises(Asked) as told:
        estimate(Samples())
    assert told.value.args == (1, {1})
    assert in_use() == (2, {2})
