"""In the YAML blocks every key is an argument, no number is read as text, and every block trains."""

import inspect
from importlib import resources

import pytest
import yaml

from sb3_tdpg import TDPG, SelectionCallback, hyperparams
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.information import get_estimator_class
from sb3_tdpg.policies import TRVPolicy

BLOCKS = sorted(yaml.safe_load(resources.files(hyperparams).joinpath("tdpg.yml").read_text()))
ZOO_KEYS = {"n_timesteps", "env_kwargs", "vec_env_wrapper", "callback"}


def env_id_of(block):
    return block[: block.index("-v") + 3]


def lava(block="Lava-v0", **overrides):
    return make_training("Lava-v0", load_hyperparams(block), **overrides)


@pytest.mark.parametrize("block", BLOCKS)
def test_every_key_of_a_block_is_an_argument(block):
    settings = load_hyperparams(block)
    assert set(settings) <= ZOO_KEYS | set(inspect.signature(TDPG).parameters)
    assert set(settings.get("policy_kwargs", {})) <= set(inspect.signature(TRVPolicy).parameters)
    estimator = get_estimator_class(settings.get("mi_estimator", "logdet"))
    accepted = {name for cls in estimator.__mro__[:-1] for name in inspect.signature(cls.__init__).parameters}
    assert set(settings.get("mi_kwargs", {})) <= accepted


@pytest.mark.parametrize("block", BLOCKS)
def test_every_block_trains_for_an_epoch(block):
    if env_id_of(block) == "Swimmer-v5":
        pytest.importorskip("mujoco")
    settings, cheap = load_hyperparams(block), {}
    if settings.get("mi_estimator") == "mine":
        cheap["mi_kwargs"] = {**settings.get("mi_kwargs", {}), "gradient_steps": 2, "warmup_gradient_steps": 2}
    if "batch_size" in settings:
        cheap["batch_size"] = 20 * 25  # the whole epoch
    training = make_training(env_id_of(block), settings, n_episodes=20, seed=0, **cheap)
    training.model.learn(1, training.callbacks)  # the minimum is one epoch
    assert training.model.epoch == 1


def test_a_baseline_block_differs_from_its_tdpg_block_by_no_penalty_and_no_selection():
    pg, tdpg = lava("Lava-v0-pg"), lava()
    assert pg.model.mi_coef == 0 < tdpg.model.mi_coef
    assert pg.selection is None
    assert isinstance(tdpg.selection, SelectionCallback)
    assert tdpg.selection.mi_limit == 0.05


def test_a_learning_rate_may_fall_linearly_as_in_the_zoo():
    model = lava(learning_rate="lin_1.0e-3").model
    assert [model.lr_schedule(x) for x in (1.0, 0.5, 0.0)] == pytest.approx([1e-3, 5e-4, 0.0])
    with pytest.raises(ValueError, match=r"'cos_1e-3' must be a number, a function, or a text such as 'lin_1e-3'"):
        lava(learning_rate="cos_1e-3")


def test_beta_may_fall_linearly_too(tmp_path):
    model = lava(beta="lin_0.5_0.1").model
    model._current_progress_remaining = 0.75
    assert model.mi_coef == pytest.approx(1 / 0.4)
    model.save(tmp_path / "model.zip")
    loaded = TDPG.load(tmp_path / "model.zip")
    loaded._current_progress_remaining = 0.0
    assert loaded.mi_coef == pytest.approx(10.0)


def test_an_unknown_block_is_refused_with_the_list_and_a_block_may_be_changed_by_its_reader():
    with pytest.raises(KeyError, match=r"no block 'Lava-v9'; it has .*Lava-v0-pg"):
        load_hyperparams("Lava-v9")
    load_hyperparams("Lava-v0")["policy_kwargs"].clear()
    assert load_hyperparams("Lava-v0")["policy_kwargs"]
