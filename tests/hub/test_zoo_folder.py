"""Cards of folders that rl-zoo3's train and ours wrote: which policy they describe, and how it was trained."""

import json
import shutil
import sys
import zipfile

import pandas as pd
import pytest
import yaml
from published_cards import REPO_ID, text_of
from small_problems import lava_env
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import TDPG
from sb3_tdpg.common.provenance import provenance
from sb3_tdpg.envs.scenarios import LAVA, Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.evaluation.loading import load_model
from sb3_tdpg.hub import write_model_card
from sb3_tdpg.hub.publication import read_publication, read_zoo_folder


@pytest.fixture(scope="module")
def zoo_folder(tmp_path_factory):
    """Folder that the zoo's train wrote: normalised observations, and evaluations by a callback."""
    pytest.importorskip("rl_zoo3", exc_type=ModuleNotFoundError)
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager

    folder = tmp_path_factory.mktemp("zoo")
    block = dict(
        policy="TRVPolicy",
        n_timesteps=500,
        n_envs=2,
        n_episodes=20,
        beta=float("inf"),
        normalize=dict(norm_obs=True, norm_reward=False),
        env_kwargs=dict(action_cost=1.0),
    )
    (folder / "conf.yml").write_text(yaml.safe_dump({"Lava-v0": block}))
    flags = f"train --algo tdpg --env Lava-v0 --seed 3 -f {folder}/logs --conf-file {folder}/conf.yml --eval-freq 100"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rl_zoo3.ALGOS, "tdpg", TDPG)
        # Another test may have called register() in this process.
        patch.setattr(rl_zoo3.train, "ExperimentManager", ExperimentManager)
        patch.setattr(sys, "argv", flags.split())
        rl_zoo3.train.train()
    return folder / "logs" / "tdpg" / "Lava-v0_1"


def test_the_policy_of_a_zoo_folder_is_evaluated_and_described(zoo_folder, tmp_path):
    card = write_model_card(zoo_folder, tmp_path / "card", REPO_ID, n_eval_episodes=10)
    records = pd.read_csv(card / "episodes.csv")
    assert records.groupby("scenario").size().to_dict() == {row.name: 10 for row in LAVA}

    statistics = zoo_folder / "Lava-v0" / "vecnormalize.pkl"
    assert (card / "vec_normalize.pkl").read_bytes() == statistics.read_bytes()
    env = VecNormalize.load(str(statistics), lava_env(1))
    model = TDPG.load(card / "tdpg-Lava-v0.zip", env=env, device="cpu")
    by_hand = evaluate_scenarios(model, LAVA, 10, env_kwargs=dict(action_cost=1.0))
    assert records["cost"].to_numpy() == pytest.approx(by_hand["cost"].to_numpy())
    assert "VecNormalize.load" in text_of(card)

    for name in ("args.yml", "config.yml", "command.txt"):
        assert (card / name).read_bytes() == (zoo_folder / "Lava-v0" / name).read_bytes()
    with zipfile.ZipFile(card / "train_eval_metrics.zip") as archive:
        assert set(archive.namelist()) == {"0.monitor.csv", "1.monitor.csv", "evaluations.npz"}
    text = text_of(card)
    assert "gym.make('Lava-v0', action_cost=1.0)" in text
    assert "training seed: 3\n" in text
    assert "The policy is the last one." in text
    assert (card / "training.png").exists()


def test_the_first_row_is_the_training_environment_however_it_was_changed(zoo_folder, tmp_path):
    copy = shutil.copytree(zoo_folder, tmp_path / "Lava-v0_1")
    for path in (copy / "Lava-v0").glob("*.yml"):
        text = path.read_text().replace("- Lava-v0", "- sb3_tdpg:Lava-v0")
        path.write_text(text.replace("action_cost: 1", "sensor_noise_std: 1"))
    publication = read_publication(copy, 2)
    assert [row.name for row in publication.scenarios] == [row.name for row in LAVA]
    training = [Scenario("Training", "Lava-v0", dict(sensor_noise_std=1.0))]
    expected = evaluate_scenarios(load_model(publication.model, "Lava-v0", {}), training, 2)["cost"]
    assert publication.records["cost"][:2].tolist() == expected.tolist()


def test_the_training_curve_of_a_zoo_folder_comes_from_its_monitor_files(zoo_folder):
    progress = read_publication(zoo_folder, 2).progress
    rewards = load_results(str(zoo_folder))["r"].to_numpy()
    assert len(rewards) == 100
    assert progress["time/iterations"].tolist() == [1, 2, 3, 4, 5]
    assert progress["rollout/ep_cost_mean"].to_numpy() == pytest.approx(-rewards.reshape(5, 20).mean(axis=1))


def test_a_zoo_folder_without_its_last_policy_is_refused(zoo_folder, tmp_path):
    copy = shutil.copytree(zoo_folder, tmp_path / "Lava-v0_1")
    (copy / "Lava-v0.zip").unlink()
    with pytest.raises(ValueError, match=r"has no Lava-v0.zip: let the training end first"):
        read_publication(copy, 2)


def test_a_training_with_wrappers_is_not_evaluated_without_them(zoo_folder, tmp_path):
    copy = shutil.copytree(zoo_folder, tmp_path / "wrapped")
    (path,) = copy.glob("*/config.yml")
    path.write_text(path.read_text() + "  - - env_wrapper\n    - rl_zoo3.wrappers.TimeFeatureWrapper\n")
    with pytest.raises(ValueError, match="was trained with env_wrapper"):
        read_zoo_folder(copy, 2)


def test_the_card_of_our_own_folder_says_which_policy_it_is(zoo_folder, tmp_path):
    copy = shutil.copytree(zoo_folder, tmp_path / "Lava-v0_1")
    (copy / "selected.json").write_text(json.dumps(dict(epoch=3, cost=17.0, information=0.5)))

    def notes():
        return " ".join(read_publication(copy, 2).notes)

    assert "The policy is the last one" in notes()  # the zoo's own program saves this one
    assert "epoch 3" not in notes()
    (copy / "run.json").write_text(json.dumps(dict(provenance=provenance())))
    assert "The selection chose the policy of epoch 3" in notes()
    assert "last" not in notes()
    (copy / "checkpoint.zip").touch()  # interrupted
    assert "The policy is the last one" in notes()
    assert "epoch 3" not in notes()


PAYLOAD = "!!python/object/apply:os.system ['touch {marker}']"


@pytest.mark.parametrize("name", ["args.yml", "config.yml"])
def test_a_file_of_a_zoo_folder_that_would_run_code_is_refused(name, zoo_folder, tmp_path):
    folder, marker = tmp_path / "Lava-v0_1", tmp_path / "marker"
    shutil.copytree(zoo_folder, folder)
    (folder / "Lava-v0" / name).write_text(PAYLOAD.format(marker=marker))
    with pytest.raises(ValueError, match=rf"{name} is not plain data that rl-zoo3 wrote") as refused:
        read_publication(folder, 2)
    assert len(str(refused.value).splitlines()) == 1
    assert not marker.exists()
