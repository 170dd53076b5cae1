"""Trainings in one batch come out as they do alone."""

import math
import shutil

import pytest
import torch as th
from small_problems import TINY_CRITIC, assert_same_parameters, parameters, tiny_tdpg

from sb3_tdpg.callbacks import SelectionCallback, TrainingCheckpointCallback
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.policy_update import PolicyUpdate
from sb3_tdpg.runs import Run, complete_run, complete_runs, train_together
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.training_batch import Member, MemberDivergedError, TrainingBatch, batch_key

N = 64  # with T = 5 and layers of 8, vectors end with whole blocks of 64
WIDE_CRITIC = {**TINY_CRITIC, "batch_size": 16, "warmup_gradient_steps": 30}
CASES = dict(
    logdet=dict(mi_estimator="logdet"),
    loo=dict(mi_estimator="loo"),
    mine=dict(mi_estimator="mine", mi_kwargs=WIDE_CRITIC),
    mine_averaged=dict(mi_estimator="mine", mi_kwargs={**WIDE_CRITIC, "ema_decay": 0.9, "standardize": True}),
    infonce=dict(mi_estimator="infonce", mi_kwargs=WIDE_CRITIC),
    smile=dict(mi_estimator="smile", mi_kwargs={**WIDE_CRITIC, "batch_size": 64}, n_episodes=2 * N),
    always_refitted=dict(mi_estimator="mine", mi_kwargs={**WIDE_CRITIC, "refit_below": 0.0}),
    policy_gradient=dict(beta=math.inf),
    pathwise=dict(encoder_gradient="pathwise"),
    pathwise_policy_gradient=dict(encoder_gradient="pathwise", beta=math.inf),
    shared_weights=dict(policy_kwargs=dict(net_arch=dict(encoder=[8], action_head=[8]), time_varying=False)),
    normalized=dict(normalize_advantage=True, max_grad_norm=0.5, baseline="mean"),
)


def model_of(k, **kwargs):
    """The first and the third differ in the seed only, the second in the weight of the information, too."""
    beta = (1 / 25, 1 / 75, 1 / 25)[k]
    return tiny_tdpg(**{"n_episodes": N, "seed": k, "beta": beta, **kwargs})


def n_timesteps(n_epochs):
    return n_epochs * N * 5


@pytest.mark.parametrize("kwargs", CASES.values(), ids=CASES.keys())
def test_every_training_of_a_batch_comes_out_bit_for_bit_as_alone(kwargs):
    alone, members = [], []
    for k in range(3):
        alone.append(model_of(k, **kwargs).learn(n_timesteps(4)))
    for k in range(3):
        members.append(Member(model_of(k, **kwargs), n_timesteps(4)))
    TrainingBatch(members).learn()
    for one, member in zip(alone, members, strict=True):
        assert_same_parameters(parameters(one.policy), parameters(member.model.policy))
        assert_same_parameters(parameters(one.estimator), parameters(member.model.estimator))
        assert (one.num_timesteps, one.epoch) == (member.model.num_timesteps, member.model.epoch)
        if one.information is None:
            assert member.model.information is None
        else:
            assert one.information.tolist() == member.model.information.tolist()
    different = [parameters(member.model.policy)["encoder.mlp.layers.0.weight"] for member in members]
    assert not th.equal(different[0], different[1])
    assert not th.equal(different[0], different[2])


def test_callbacks_see_their_own_training(tmp_path):
    def callbacks(k):
        return [SelectionCallback(cost_limit=1e6), TrainingCheckpointCallback(tmp_path / f"{k}.zip", save_freq=2)]

    alone, members = [], []
    for k in range(2):
        selection, checkpoint = callbacks(k)
        model = model_of(k).learn(n_timesteps(5), [selection, checkpoint])
        alone.append((selection.best, parameters(TDPG.load(tmp_path / f"{k}.zip").policy), model))
    for k in range(2):
        members.append(Member(model_of(k), n_timesteps(5), callbacks(k)))
    TrainingBatch(members).learn()
    for k, (best, saved, model) in enumerate(alone):
        assert members[k].callbacks[0].best == best
        assert_same_parameters(parameters(TDPG.load(tmp_path / f"{k}.zip").policy), saved)
        assert len(members[k].model.ep_info_buffer) == len(model.ep_info_buffer)


def test_a_training_can_be_taken_into_another_batch_on_its_way(tmp_path):
    whole = model_of(0).learn(n_timesteps(4), TrainingCheckpointCallback(tmp_path / "0.zip", save_freq=2))
    model_of(1).learn(n_timesteps(4), TrainingCheckpointCallback(tmp_path / "1.zip", save_freq=2))
    members = []
    for k in range(2):
        model = TDPG.load(tmp_path / f"{k}.zip", env=model_of(k).env, device="cpu")
        members.append(Member(model, model.remaining_timesteps, reset_num_timesteps=False))
    assert members[0].model.epoch == 2
    TrainingBatch(members).learn()
    assert_same_parameters(parameters(whole.policy), parameters(members[0].model.policy))


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(n_epochs=2, clip_range=0.2),
        dict(batch_size=32, clip_range=0.2),
        dict(n_envs=32),
        dict(beta="auto", cost_limit=20.0),
        dict(mi_estimator="mine", mi_kwargs={**TINY_CRITIC, "held_out": 0.5}),
        dict(mi_estimator="mine", mi_kwargs={**TINY_CRITIC, "reset_moments": False}),
    ],
)
def test_what_must_be_trained_alone_has_no_key(kwargs):
    assert batch_key(model_of(0)) is not None
    assert batch_key(model_of(0, **kwargs)) is None


def test_only_seed_and_beta_may_differ():
    key = batch_key(model_of(0))
    assert key == batch_key(model_of(1)) == batch_key(model_of(0, learning_rate=1e-4))
    for other in (
        dict(beta=math.inf),
        dict(n_episodes=32),
        dict(mi_estimator="loo"),
        dict(encoder_gradient="pathwise"),
    ):
        assert batch_key(model_of(0, **other)) not in (None, key)
    with pytest.raises(ValueError, match="do not fit into one batch"):
        TrainingBatch([Member(model_of(0), 1), Member(model_of(0, beta=math.inf), 1)])


def test_a_training_that_diverges_is_named():
    members = [Member(model_of(k), n_timesteps(3)) for k in range(3)]
    members[1].model.env.env.action_cost = math.nan
    with pytest.raises(MemberDivergedError, match="costs of epoch 0 is NaN") as error:
        TrainingBatch(members).learn()
    assert error.value.index == 1


# -- runs -------------------------------------------------------------------------------------------------------

OVERRIDES = dict(n_timesteps=1600, n_episodes=N, callback=[])


def runs(tmp_path, betas=(1 / 25, 1 / 75), seeds=(0, 1), **overrides):
    def task(beta, seed):
        name = f"{beta:.3f}-{seed}"
        settings = {**OVERRIDES, "beta": beta, **overrides}
        return Run(name, "Lava-v0", "Lava-v0-logdet", seed, settings), tmp_path / name, LAVA[:2]

    return [task(beta, seed) for beta in betas for seed in seeds]


def files_of(folder):
    policy = TDPG.load(folder / "model.zip", device="cpu").policy
    return parameters(policy), (folder / "episodes.csv").read_bytes()


def assert_same_runs(first, second):
    for one, other in zip(first, second, strict=True):
        (policy, records), (other_policy, other_records) = files_of(one[1]), files_of(other[1])
        assert_same_parameters(policy, other_policy)
        assert records == other_records


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    tasks = runs(tmp_path_factory.mktemp("alone"))
    for task in tasks:
        complete_run(*task, n_eval_episodes=4)
    return tasks


def test_runs_that_fit_are_trained_together_and_come_out_as_alone(tmp_path, alone, monkeypatch):
    tasks = runs(tmp_path)
    train_together(tasks, n_eval_episodes=4)
    assert all((folder / "attempt0" / "model.zip").exists() for _, folder, _ in tasks)
    assert not list(tmp_path.glob("*/attempt0/checkpoint.zip"))
    monkeypatch.setattr(TDPG, "learn", None)  # nothing is left to train
    for task in tasks:
        complete_run(*task, n_eval_episodes=4)
    assert_same_runs(tasks, alone)
    train_together(tasks, n_eval_episodes=4)  # finished


def test_a_batch_that_was_killed_goes_on_from_the_checkpoints(tmp_path, alone, monkeypatch):
    tasks = runs(tmp_path)
    monkeypatch.setattr("sb3_tdpg.runs.MAX_CHECKPOINT_EPOCHS", 2)
    train = TrainingBatch._train

    def die(batch):
        if batch.models[0].epoch == 3:
            raise KeyboardInterrupt
        train(batch)

    monkeypatch.setattr(TrainingBatch, "_train", die)
    with pytest.raises(KeyboardInterrupt):
        train_together(tasks, n_eval_episodes=4)
    assert len(list(tmp_path.glob("*/attempt0/checkpoint.zip"))) == len(tasks)
    # As if the process had been killed while it wrote them: one run has to begin again.
    shutil.rmtree(tasks[0][1])
    monkeypatch.setattr(TrainingBatch, "_train", train)
    train_together(tasks, n_eval_episodes=4)
    trained = [(folder / "attempt0" / "model.zip").exists() for _, folder, _ in tasks]
    assert trained == [False, True, True, True]  # the one that fits with no other is left alone
    for task in tasks:
        complete_run(*task, n_eval_episodes=4)
    assert_same_runs(tasks[1:], alone[1:])
    assert files_of(tasks[0][1])[1] == files_of(alone[0][1])[1]


def test_one_that_diverges_does_not_take_the_others_with_it(tmp_path, alone, monkeypatch):
    tasks = runs(tmp_path)
    loss = PolicyUpdate.loss

    def diverge(update, *arguments):
        value = loss(update, *arguments)
        if update.model.seed == 1 and update.model.epoch == 2 and update.mi_coef > 50:
            raise update._diverged("loss")
        return value

    monkeypatch.setattr(PolicyUpdate, "loss", diverge)
    train_together(tasks, n_eval_episodes=4)
    trained = [(folder / "attempt0" / "model.zip").exists() for _, folder, _ in tasks]
    assert trained == [True, True, True, False]
    for task in tasks[:3]:
        complete_run(*task, n_eval_episodes=4)
    assert_same_runs(tasks[:3], alone[:3])
    with pytest.raises(ValueError, match="loss of epoch 2 is NaN or infinite"):
        complete_run(*tasks[3], n_eval_episodes=4)


def test_worker_processes_train_batches(tmp_path, alone, monkeypatch):
    tasks = runs(tmp_path)
    complete_runs(tasks, n_eval_episodes=4, jobs=1)
    assert_same_runs(tasks, alone)


def test_runs_that_fit_into_no_batch_are_left_alone(tmp_path):
    tasks = runs(tmp_path, betas=(1 / 25,), batch_size=32, clip_range=0.2)
    train_together(tasks, n_eval_episodes=4)
    assert not list(tmp_path.glob("*/attempt0/model.zip"))
