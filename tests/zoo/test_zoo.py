"""``sb3-tdpg train``, ``enjoy``, ``record-video`` and ``plot``: the programs of rl-zoo3 with TDPG as an algorithm."""

import json
import pickle
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from programs import run, start, wait_for
from small_problems import assert_same_parameters, error_line, parameters, stopped_in_epoch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import load_results

from sb3_tdpg import TDPG, hyperparams
from sb3_tdpg.cli import main
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.vec_env import make_episodes_env

pytest.importorskip("rl_zoo3")

LAVA = ["--env", "Lava-v0", "--block", "Lava-v0-logdet", "--eval-freq", "-1", "--verbose", "0"]
# Twenty epochs of 20 episodes, with a checkpoint in the tenth.
SHORT = [*LAVA, "-params", "n_episodes:20", "-n", "2000"]
FILES = sorted(Path(hyperparams.__file__).parent.glob("*.yml"))


def folder_of(path, n=1, algo="tdpg", env="Lava-v0"):
    return path / "logs" / algo / f"{env}_{n}"


def test_train_leaves_a_model_and_says_how_it_was_made(here):
    assert main(["train", *SHORT, "--seed", "3"]) == 0
    folder = folder_of(here)
    model = TDPG.load(folder / "Lava-v0.zip", device="cpu")
    assert (model.num_timesteps, model.n_episodes, model.mi_estimator) == (2000, 20, "logdet")
    record = json.loads((folder / "run.json").read_text())
    assert (record["seed"], record["block"], record["algo"]) == (3, "Lava-v0-logdet", "tdpg")
    assert record["hyperparams"]["n_episodes"] == 20
    assert record["provenance"]["versions"]["sb3_tdpg"]
    assert len(load_results(str(folder))) == 400  # every episode, though all of them are one batch
    assert not (folder / "checkpoint.zip").exists()
    assert not list(folder.rglob("*.partial"))


def test_our_environments_run_as_a_batch_for_any_algorithm_and_others_get_their_keywords(here, monkeypatch):
    from sb3_tdpg.zoo.manager import TDPGExperimentManager

    made = []
    create_envs = TDPGExperimentManager.create_envs

    def spy(self, n_envs, eval_env=False, no_log=False):
        env = create_envs(self, n_envs, eval_env, no_log)
        made.append((env.unwrapped, eval_env))
        return env

    monkeypatch.setattr(TDPGExperimentManager, "create_envs", spy)
    arguments = ["train", "--algo", "ppo", "--env", "Lava-v0", "-n", "100", "--eval-freq", "-1"]
    assert main([*arguments, "-params", "n_envs:20", "batch_size:50"]) == 0
    assert main([*arguments, "-params", "n_envs:2", "batch_size:10", "--vec-env", "subproc"]) == 0
    pendulum = ["train", "--env", "Pendulum-v1", "-n", "100", "-params", "n_episodes:2", "batch_size:100"]
    assert main([*pendulum, "--env-kwargs", "g:8.0", "--eval-env-kwargs", "g:5.0"]) == 0
    kinds = [(type(env).__name__, env.num_envs) for env, is_evaluation in made if not is_evaluation]
    assert kinds == [("BatchedVecEnv", 20), ("SubprocVecEnv", 2), ("DummyVecEnv", 2)]
    gravities = {is_evaluation: env.get_attr("unwrapped")[0].g for env, is_evaluation in made[2:]}
    assert gravities == {False: 8.0, True: 5.0}
    PPO.load(folder_of(here, algo="ppo") / "Lava-v0.zip", device="cpu")


def test_a_resumed_training_ends_with_the_policy_of_an_uninterrupted_one(here):
    settings = ["n_episodes:20", "normalize:dict(norm_obs=True,norm_reward=False)", "callback:[]"]
    arguments = ["train", *LAVA, "-params", *settings, "-n", "8000", "--seed", "1"]
    process = start(arguments, here)
    wait_for(here, "logs/tdpg/Lava-v0_1/checkpoint.zip", process)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "--resume logs/tdpg/Lava-v0_1" in output
    before = len(load_results(str(folder_of(here))))
    assert main(["train", "--resume", "logs/tdpg/Lava-v0_1", "--seed", "2"]) == 2
    assert main(["train", "--resume", "logs/tdpg/Lava-v0_1"]) == 0
    assert not (folder_of(here) / "checkpoint.zip").exists()
    assert len(load_results(str(folder_of(here)))) > before
    assert main(["train", "--resume", "logs/tdpg/Lava-v0_1"]) == 2  # it is finished

    assert main(arguments) == 0
    resumed, whole = (TDPG.load(folder_of(here, n) / "Lava-v0.zip", device="cpu") for n in (1, 2))
    assert resumed.num_timesteps == whole.num_timesteps
    assert_same_parameters(parameters(resumed.policy), parameters(whole.policy))
    files = [folder_of(here, n) / "Lava-v0" / "vecnormalize.pkl" for n in (1, 2)]
    resumed, whole = (pickle.loads(file.read_bytes()).obs_rms for file in files)
    assert (resumed.mean == whole.mean).all() and (resumed.var == whole.var).all()


def test_a_resumed_training_keeps_its_evaluations_and_logs_and_refuses_other_settings(here, capsys, monkeypatch):
    (here / "mine.yml").write_text(yaml.safe_dump({"CartPole-v1": load_hyperparams("CartPole-v1")}))
    arguments = ["train", "--env", "CartPole-v1", "-params", "epoch_steps:200", "batch_size:100", "n_epochs:1"]
    arguments += ["--conf-file", "mine.yml", "-tb", "tensorboard"]
    arguments += ["-n", "3600", "--eval-freq", "700", "--eval-episodes", "2", "--seed", "1", "--save-freq", "700"]
    with stopped_in_epoch(13):
        assert main([*arguments, "-f", "my logs"]) == 130
    assert "--resume 'my logs/tdpg/CartPole-v1_1'`" in capsys.readouterr().out
    folder = (here / "my logs").rename(here / "logs") / "tdpg" / "CartPole-v1_1"
    n_episodes = sum(len(path.read_text().splitlines()) - 2 for path in folder.glob("*.monitor.csv"))
    record = json.loads((folder / "run.json").read_text())
    record["hyperparams"]["n_epochs"] = 2
    other = shutil.copytree(folder, here / "other")
    (other / "run.json").write_text(json.dumps(record))
    capsys.readouterr()
    assert main(["train", "--resume", str(other)]) == 2
    assert "was trained with other settings than" in capsys.readouterr().err

    monkeypatch.chdir(other)
    assert main(["train", "--resume", str(folder)]) == 0
    assert not (other / "tensorboard").exists()
    monkeypatch.chdir(here)
    assert main(arguments) == 0
    again = folder_of(here, 2, env="CartPole-v1")
    resumed, whole = (TDPG.load(each / "CartPole-v1.zip", device="cpu") for each in (folder, again))
    assert_same_parameters(parameters(resumed.policy), parameters(whole.policy))
    evaluations = [np.load(each / "evaluations.npz")["timesteps"] for each in (folder, again)]
    assert len(evaluations[0]) == len(evaluations[1])
    saved = [{path.name for path in each.glob("rl_model_*.zip")} for each in (folder, again)]
    assert saved[0] == saved[1]
    kept = sum(len(path.read_text().splitlines()) - 2 for path in folder.glob("*.monitor.csv"))
    assert kept > n_episodes


def test_a_model_of_the_zoo_loads_without_it_and_its_rates_may_end_anywhere(here):
    block = {**load_hyperparams("Lava-v0-pg"), "learning_rate": "lin_1e-3_1e-5"}
    (here / "mine.yml").write_text(yaml.dump({"Lava-v0": block}))
    assert main(["train", *LAVA[:2], "--conf-file", "mine.yml", "-n", "500", "-params", "n_episodes:20"]) == 0
    path = folder_of(here) / "Lava-v0.zip"
    code = f"import sys; sys.modules['rl_zoo3'] = None; from sb3_tdpg import TDPG; TDPG.load({str(path)!r})"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_selected_policy_is_saved(here, capsys):
    selection = "callback:[{'sb3_tdpg.callbacks.SelectionCallback':{'cost_limit':1e6}}]"
    assert main(["train", *LAVA, "-params", "n_episodes:20", selection, "-n", "2000", "--seed", "1"]) == 0
    assert "selected the policy of epoch" in capsys.readouterr().out
    folder = folder_of(here)
    chosen, kept = (TDPG.load(folder / name, device="cpu") for name in ("selected.zip", "Lava-v0.zip"))
    assert chosen.num_timesteps < kept.num_timesteps == 2000  # it was not the last one
    assert_same_parameters(parameters(chosen.policy), parameters(kept.policy))


def test_enjoy_finds_the_latest_model_and_runs_its_stochastic_policy(here, capsys, monkeypatch):
    main(["train", *SHORT])
    drawn = []
    predict = TDPG.predict
    monkeypatch.setattr(TDPG, "predict", lambda *a, **k: (drawn.append(k["deterministic"]), predict(*a, **k))[1])
    assert main(["enjoy", "--env", "Lava-v0", "--no-render", "-n", "20"]) == 0
    assert "4 Episodes" in capsys.readouterr().out
    assert set(drawn) == {False}
    assert main(["enjoy", "--env", "Lava-v0", "--no-render", "-n", "20", "--deterministic"]) == 0
    assert drawn[-1] is True


@pytest.mark.filterwarnings("ignore:No artists with labels")
def test_plot_and_video_of_a_training(here, capsys):
    main(["train", *SHORT])
    assert main(["plot", "-e", "Lava-v0", "--save", "curve.png"]) == 0
    assert (here / "curve.png").stat().st_size > 5000
    assert "-e Nope` gives an empty figure" in error_line(capsys, "plot", "-e", "Nope", "--save", "empty.png")
    assert not (here / "empty.png").exists()
    assert main(["record-video", "--env", "Lava-v0", "-n", "5"]) == 0
    (film,) = here.rglob("*.mp4")
    assert film.stat().st_size > 1000


def test_the_evaluation_uses_the_keywords_of_the_block(here, monkeypatch):
    made = []

    def make(*arguments, env_kwargs, **others):
        made.append(env_kwargs)
        return make_episodes_env(*arguments, env_kwargs=env_kwargs, **others)

    monkeypatch.setattr("sb3_tdpg.zoo.manager.make_episodes_env", make)
    arguments = ["train", "--env", "Lava-v0", "--block", "Lava-v0-logdet-table", "-n", "100"]
    assert main([*arguments, "-params", "n_episodes:20"]) == 0
    assert all(kwargs["lava_stage_cost"] == 3.0 for kwargs in made)


@pytest.mark.parametrize("flags, message", [
    (["--betas", "3"], "unrecognized arguments: --betas 3"),
    (["--algo", "foo"], "argument --algo: invalid choice: 'foo'"),
], ids=["unknown", "choice"])  # fmt: skip
def test_flags_that_the_zoo_does_not_know_are_refused_by_its_parser(flags, message, here, capfd):
    with pytest.raises(SystemExit) as stop:
        main(["train", "--env", "Lava-v0", *flags])
    assert stop.value.code == 2
    assert capfd.readouterr().err.splitlines()[-1].startswith(f"sb3-tdpg train: error: {message}")
    assert not list(here.glob("logs/*/*"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_no_number_of_our_files_is_read_as_text(path):
    def texts(value):
        if isinstance(value, (dict, list)):
            items = value.values() if isinstance(value, dict) else value
            return [text for item in items for text in texts(item)]
        return [value] if isinstance(value, str) else []

    for text in texts(yaml.safe_load(path.read_text())):
        with pytest.raises(ValueError):
            float(text)


@pytest.mark.parametrize("algo", ["a2c", "ppo", "ppo_lstm", "trpo"])
@pytest.mark.parametrize("env_id", ["Lava-v0", "BallCatch-v0", "PandaGrasp-v0"])
def test_blocks_of_other_algorithms_train(algo, env_id, here):
    few = ["n_envs:4", *([] if algo == "a2c" else ["batch_size:20" if env_id != "PandaGrasp-v0" else "batch_size:4"])]
    assert main(["train", "--algo", algo, "--env", env_id, "-params", *few, "-n", "8", "--eval-freq", "-1"]) == 0
    (model,) = here.glob(f"logs/{algo}/{env_id}_1/{env_id}.zip")
    assert model.stat().st_size > 1000


def test_the_zoos_own_program_takes_tdpg_as_its_documentation_says(here):
    """A script that adds the algorithm and calls the zoo's train()."""
    (here / "train.py").write_text(
        "import rl_zoo3\nimport rl_zoo3.train\nfrom rl_zoo3.train import train\nfrom sb3_tdpg import TDPG\n"
        'rl_zoo3.ALGOS["tdpg"] = TDPG\nrl_zoo3.train.ALGOS = rl_zoo3.ALGOS\nrl_zoo3.exp_manager.ALGOS = rl_zoo3.ALGOS\n'
        'if __name__ == "__main__":\n    train()\n'
    )
    path = Path(hyperparams.__file__).with_name("tdpg.yml")
    command = ["train.py", "--algo", "tdpg", *SHORT[:2], "--conf-file", str(path), "-n", "200"]
    run([*command, "-params", "n_episodes:20", "--eval-freq", "-1"], here)
    assert folder_of(here).joinpath("Lava-v0.zip").exists()


def test_a_training_is_continued_from_a_model_with_other_settings(here):
    assert main(["train", *SHORT]) == 0
    first = TDPG.load(folder_of(here) / "Lava-v0.zip", device="cpu")
    assert main(["train", *SHORT, "-i", "logs/tdpg/Lava-v0_1/Lava-v0.zip", "-params", "n_episodes:20", "beta:0.5"]) == 0
    second = TDPG.load(folder_of(here, 2) / "Lava-v0.zip", device="cpu")
    assert (first.beta, second.beta) == (1 / 75, 0.5)
    n_steps = [model.policy.optimizer.state_dict()["state"][0]["step"] for model in (first, second)]
    assert n_steps[1] > n_steps[0]


def test_help_lists_our_flags_and_the_zoos(capsys):
    own = (("train", "--resume"), ("tune", "--objective"), ("plot", "--save"), ("enjoy", "--exp-id"))
    for program, flag in own:
        with pytest.raises(SystemExit) as stop:
            main([program, "--help"])
        assert stop.value.code == 0
        text = capsys.readouterr().out
        assert flag in text and ("--n-timesteps" in text or "--exp-folder" in text)
        assert "trusting whoever" not in text  # nothing is loaded


def test_a_training_that_a_callback_ends_early_is_finished(here):
    """A callback that ends a training is not an interrupt."""
    stop = "callback:[{'stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes':{'max_episodes':1}}]"
    assert main(["train", *LAVA, "-params", "n_episodes:20", stop, "-n", "20000"]) == 0
    assert TDPG.load(folder_of(here) / "Lava-v0.zip", device="cpu").num_timesteps < 20_000
    assert not (folder_of(here) / "checkpoint.zip").exists()
