"""Workers that share a study: real processes on a real PostgreSQL, on SQLite and on a journal file."""

import re
import sqlite3
import threading
import time

import pytest

optuna = pytest.importorskip("optuna")

from optuna.trial import TrialState  # noqa: E402
from postgres import PASSWORD, postgres  # noqa: E402, F401
from study_workers import Workers, open_quick  # noqa: E402

from sb3_tdpg.experiments import storages, studies, study_worker  # noqa: E402
from sb3_tdpg.experiments.studies import (  # noqa: E402
    UnfitWorkerError,
    enqueue_once,
    open_storage,
    open_study,
    quiet_optuna,
    work,
)

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


@pytest.fixture(autouse=True)
def silent_optuna():
    quiet_optuna()


@pytest.fixture(params=["postgresql", "sqlite", "journal"])
def url(request, tmp_path):
    """A storage that has never been used."""
    if request.param == "postgresql":
        server = request.getfixturevalue("postgres")
        return server.create_database("d" + re.sub(r"\W", "_", tmp_path.name).lower())
    return f"sqlite:///{tmp_path}/study.db" if request.param == "sqlite" else str(tmp_path / "study.log")


def work_quickly(study, objective, n_trials=None, **kwargs):
    settings = dict(heartbeat_interval=0.1, grace_period=0.5, report=lambda _: None)
    work(study, objective, n_trials, **{**settings, **kwargs})


@pytest.fixture
def workers(tmp_path, url):
    made = []

    def make(n_trials):
        made.append(Workers(tmp_path, url, n_trials))
        return made[-1]

    yield make
    for each in made:
        each.stop()


def test_a_trial_whose_worker_is_killed_is_run_again_with_its_parameters_and_exactly_n_are_finished(workers, url):
    team = workers(8)
    (victim,) = team.start(60)
    team.wait_for("begin", victim)  # the others might leave nothing to it
    others = team.start(0.1, 0.1)
    team.send("SIGKILL", victim)
    team.join(others)

    trials = open_quick(url).get_trials()
    finished = [t for t in trials if t.state in FINISHED]
    assert len(finished) == 8
    assert not [t for t in trials if t.state in (TrialState.RUNNING, TrialState.WAITING)]
    (lost,) = team.lines("begin", victim)
    assert sum((str(t.params["x"]), str(t.params["y"])) == lost for t in finished) == 1
    assert "is silent for 2 s: to be run again" in team.said
    # Nothing counts twice, and no two workers tried the same point though their samplers have the same seed.
    ended = team.lines("end")
    assert len(set(ended)) == 8
    assert len(ended) - dropped(team) == 8


def test_every_job_is_done_once_by_workers_that_begin_at_once_while_one_is_killed(workers, url):
    team = workers(None)
    (victim,) = team.start(60)
    team.wait_for("begin", victim)  # the others might leave nothing to it
    others = team.start(0.2, 0.2)
    team.send("SIGKILL", victim)
    team.join(others)

    trials = open_quick(url).get_trials()
    assert sorted(t.params["x"] for t in trials if t.state in FINISHED) == [-2, -1, 0, 1, 2, 3]
    assert len(team.lines("end")) - dropped(team) == 6
    assert not [t for t in trials if t.state in (TrialState.RUNNING, TrialState.WAITING)]


def test_a_waiting_trial_is_taken_by_one_worker_only(url):
    study, taken = open_quick(url), []
    for _ in range(40):
        study.add_trial(optuna.trial.create_trial(state=TrialState.WAITING))
    start = threading.Barrier(4)

    def take():
        mine = open_quick(url)
        start.wait()
        taken.extend(mine.ask().number for _ in range(10))

    threads = [threading.Thread(target=take) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == list(range(40))


def dropped(team):
    """Count results that were computed in vain: on a busy machine a living worker, too, may be silent for 2 s."""
    return team.said.count("its result is dropped")


def test_ctrl_c_hands_the_trial_to_the_next_worker_at_once(workers, url):
    team = workers(2)
    (first,) = team.start(60)
    team.wait_for("begin", first)
    team.send("SIGINT", first)
    first.join(20)
    assert first.exitcode not in (0, None)
    assert "trial 0 is put back into the queue" in team.said

    ran, said = [], []

    def objective(trial):
        ran.append((str(trial.suggest_float("x", -1, 1)), str(trial.suggest_float("y", -1, 1))))
        return 0.0

    work_quickly(open_quick(url), objective, 2, grace_period=60, report=said.append)
    assert len(ran) == 2
    assert ran[:1] == team.lines("begin")
    assert not [line for line in said if "silent" in line]


def test_a_worker_that_was_suspended_leaves_its_trial_to_the_one_that_has_taken_it_over(workers, url):
    team = workers(None)
    (suspended,) = team.start(60)
    team.wait_for("begin", suspended)
    team.send("SIGSTOP", suspended)
    team.join(team.start(0.1))
    team.send("SIGCONT", suspended)
    team.join([suspended])  # long before the 60 s are over
    assert team.lines("end", suspended) == []
    assert dropped(team) == 1
    finished = [t.params["x"] for t in open_quick(url).get_trials() if t.state in FINISHED]
    assert sorted(finished) == [-2, -1, 0, 1, 2, 3]


def test_workers_that_are_suspended_together_do_not_take_each_other_for_dead(monkeypatch):
    study, said, clock = open_study(optuna.storages.InMemoryStorage(), "s", space={}), [], [0.0]
    monkeypatch.setattr(study_worker.time, "monotonic", lambda: clock[0])
    study.ask()  # by another one, that gives no sign
    worker = study_worker.Worker(study, lambda trial: 0.0, 1, 3, 1.0, 6.0, said.append, study_worker.values_of)
    for seconds in (0, 1, 2, 100, 101, 103, 105, 106):
        clock[0] = seconds
        worker._look()
    assert said == []
    clock[0] = 107
    worker._look()
    assert said == ["trial 0: its worker is silent for 6 s: to be run again"]


def test_ctrl_c_in_a_trial_that_was_taken_over_is_ctrl_c_and_a_trial_that_is_done_stays_done():
    study, said = open_study(optuna.storages.InMemoryStorage(), "s", space={}), []

    def objective(trial):
        study.tell(trial.number, 1.0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work_quickly(study, objective, 1, report=said.append)
    assert said == []
    assert [t.values for t in study.get_trials()] == [[1.0]]


def test_a_result_that_cannot_be_stored_is_not_taken_for_a_bad_trial(monkeypatch):
    monkeypatch.setattr(study_worker, "PATIENCE", 0.0)
    study, tell = open_study(optuna.storages.InMemoryStorage(), "s", space={}), optuna.Study.tell

    def is_away(*args, **kwargs):
        monkeypatch.setattr(optuna.Study, "tell", tell)  # back when the worker has lost its patience
        raise optuna.exceptions.StorageInternalError("gone")

    monkeypatch.setattr(optuna.Study, "tell", is_away)
    with pytest.raises(ValueError, match="the storage has not answered for 0 s: gone"):
        work_quickly(study, lambda trial: 1.0, 1)
    assert [t.state for t in study.get_trials()] == [TrialState.RUNNING]
    work_quickly(study, lambda trial: 1.0, 1)  # after the grace period
    assert [t.state for t in study.get_trials()] == [TrialState.FAIL, TrialState.COMPLETE]


def test_a_storage_that_is_away_while_an_objective_needs_it_costs_the_attempt_not_the_worker():
    study, said, values = open_study(optuna.storages.InMemoryStorage(), "s", space={}), [], []

    def objective(trial):
        values.append(trial.suggest_float("x", 0, 1))
        if len(values) == 1:
            raise optuna.exceptions.StorageInternalError("gone")
        return 1.0

    work_quickly(study, objective, 1, report=said.append)
    assert said == ["trial 0: failed: StorageInternalError: gone (0 of 1 finished)", "trial 1: 1 (1 of 1 finished)"]
    assert values[0] == values[1]


def test_a_worker_that_cannot_run_a_trial_leaves_it_to_others(url):
    study, said = open_quick(url), []

    def unfit(trial):
        raise UnfitWorkerError("folder holds another run")

    for _ in range(5):  # more often than a trial may fail
        with pytest.raises(ValueError, match="another run"):
            work_quickly(study, unfit, 1, report=said.append)
    assert said[-1] == "trial 4 is put back into the queue"
    work_quickly(study, lambda trial: 1.0, 1)
    assert [t.values for t in study.get_trials() if t.state in FINISHED] == [[1.0]]


def test_a_trial_may_be_interrupted_any_number_of_times():
    study, points = open_study(optuna.storages.InMemoryStorage(), "s", space={}), []

    def objective(trial):
        points.append(trial.suggest_float("x", 0, 1))
        if len(points) < 4:
            raise KeyboardInterrupt
        return 0.0

    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            work_quickly(study, objective, 1, max_retries=1)
    work_quickly(study, objective, 1, max_retries=1)
    assert len(points) == 4
    assert len(set(points)) == 1


def test_a_database_that_is_restarted_costs_no_trial(tmp_path, postgres):  # noqa: F811
    team = Workers(tmp_path, postgres.create_database("restarted"), 2)
    try:
        (worker,) = team.start(1.0)
        team.wait_for("begin", worker)
        postgres.stop()
        team.wait_for("end", worker)
        time.sleep(0.5)
        postgres.start()
        team.join([worker])
    finally:
        team.stop()
    assert "the storage does not answer" in team.said
    assert len(team.lines("begin")) == len(team.lines("end")) == 2


def test_workers_that_start_at_once_run_exactly_as_many_trials_as_asked_for(workers, url):
    team = workers(2)
    team.join(team.start(*[0.5] * 4))
    assert len(team.lines("begin")) == len(team.lines("end")) == 2
    assert sum(t.state in FINISHED for t in open_quick(url).get_trials()) == 2


def test_of_two_that_begin_the_last_trial_at_once_one_hands_it_back(tmp_path):
    # Both have seen that one trial is missing, and both begin one.
    url = f"sqlite:///{tmp_path}/study.db"
    first, second = open_quick(url), open_quick(url)
    ran = []
    together = threading.Barrier(2, timeout=30)

    def begin_together(study):
        ask = study.ask

        def ask_together():
            together.wait()
            trial = ask()
            together.wait()
            return trial

        study.ask = ask_together
        work_quickly(study, lambda trial: ran.append(trial.number) or time.sleep(0.3) or 0.0, 1, grace_period=30)

    threads = [threading.Thread(target=begin_together, args=(s,)) for s in (first, second)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(40)
    assert ran == [0]
    assert [t.state for t in first.get_trials()] == [TrialState.COMPLETE, TrialState.FAIL]


def test_a_value_error_prunes_the_trial_and_is_kept(url):
    study, said = open_quick(url), []

    def objective(trial):
        if trial.number == 0:
            raise ValueError("rate is too high")
        return float("nan") if trial.number == 1 else 1.0

    work_quickly(study, objective, 3, report=said.append)
    trials = study.get_trials()
    assert [t.state for t in trials] == [TrialState.PRUNED, TrialState.PRUNED, TrialState.COMPLETE]
    assert trials[0].user_attrs["reason"] == "rate is too high"
    assert "nan" in trials[1].user_attrs["reason"]
    assert said[0] == "trial 0: pruned: rate is too high (1 of 3 finished)"


def test_another_exception_stops_the_worker_and_the_trial_is_run_again_a_few_times():
    study = open_study(optuna.storages.InMemoryStorage(), "s", space={})
    points = []

    def objective(trial):
        points.append(trial.suggest_float("x", 0, 1))
        if len(points) <= 3:
            raise RuntimeError("out of memory")
        return 0.0

    for attempt in range(3):
        with pytest.raises(RuntimeError, match="out of memory"):
            work_quickly(study, objective, 2, max_retries=2)
        assert study.get_trials()[-1].user_attrs["reason"] == "RuntimeError: out of memory", attempt
    said = []
    work_quickly(study, objective, 2, max_retries=2, report=said.append)
    assert len(set(points[:3])) == 1  # the same parameters each time
    assert len(set(points)) == 3  # then two others took their place
    assert said[-1] == "trial 2 failed 3 times and is left: RuntimeError: out of memory"


def test_a_worker_that_was_taken_for_dead_cannot_finish_its_trial(tmp_path):
    study = open_quick(str(tmp_path / "study.log"))
    said = []

    def objective(trial):
        study.tell(trial.number, state=TrialState.FAIL)  # as another worker would
        return 1.0 if trial.number == 0 else 2.0

    def then_well(trial):
        return objective(trial) if trial.number == 0 else 2.0

    work_quickly(study, then_well, 1, report=said.append)
    assert said[0] == "trial 0 was taken over by another worker: its result is dropped"
    assert [t.values for t in study.get_trials()] == [None, [2.0]]


def test_a_worker_that_sees_a_slow_trial_of_another_waits_for_it(tmp_path):
    url = f"sqlite:///{tmp_path}/study.db"
    study, said, ran, begun = open_quick(url), [], [], threading.Event()

    def slow_objective(_):
        begun.set()
        time.sleep(2.0)
        return 1.0

    slow = threading.Thread(target=work_quickly, args=(open_quick(url), slow_objective, 1))
    slow.start()
    assert begun.wait(20)
    work_quickly(study, lambda trial: ran.append(trial) or 0.0, 1, grace_period=30, report=said.append)
    slow.join()
    assert said == ["waiting for 1 trials of other workers; those silent for 30 s are taken over"]
    assert ran == []
    assert [t.values for t in study.get_trials()] == [[1.0]]


def test_a_study_with_other_settings_is_refused_and_says_what_differs(url):
    open_quick(url, space={"x": [-1, 1], "env": {"id": "Lava-v0", "noise": 0.1}})
    assert open_quick(url, space={"x": (-1, 1), "env": {"id": "Lava-v0", "noise": 0.1}}).user_attrs["space"]
    with pytest.raises(ValueError, match=r"study 's' .* env.noise: 0.1 there, 0.2 here; x: \[-1, 1\] there, not here"):
        open_quick(url, space={"env": {"id": "Lava-v0", "noise": 0.2}})
    with pytest.raises(ValueError, match=r'directions: \["minimize"\] there, \["maximize"\] here'):
        open_quick(url, space={"x": [-1, 1], "env": {"id": "Lava-v0", "noise": 0.1}}, directions=["maximize"])


def test_a_study_of_another_program_is_refused(tmp_path):
    storage = open_storage(f"sqlite:///{tmp_path}/study.db")
    optuna.create_study(storage=storage, study_name="s").optimize(lambda trial: 0.0, n_trials=1)
    with pytest.raises(ValueError, match="study 's' was made by another program"):
        open_study(storage, "s", space={})


def test_a_study_whose_maker_died_before_it_said_what_it_is_can_be_used(tmp_path, monkeypatch):
    monkeypatch.setattr(studies, "CREATION_TIME", 0.2)
    storage = open_storage(f"sqlite:///{tmp_path}/study.db")
    optuna.create_study(storage=storage, study_name="s")
    assert open_study(storage, "s", space={"x": 1}).user_attrs["space"] == {"x": 1}


def test_jobs_may_be_put_into_the_queue_again_and_more_of_them(url):
    study, ran = open_quick(url), []

    def objective(trial):
        ran.append(trial.suggest_categorical("k", ["a", "b", "c"]))
        return 0.0

    enqueue_once(study, [{"k": "a"}, {"k": "b"}])
    enqueue_once(study, [{"k": "a"}, {"k": "b"}])
    work_quickly(study, objective)
    enqueue_once(study, [{"k": "b"}, {"k": "c"}])
    work_quickly(study, objective)
    assert ran == ["a", "b", "c"]


def test_a_password_is_neither_shown_nor_an_obstacle(postgres):  # noqa: F811
    open_storage(postgres.url())
    shown = None
    try:
        open_storage(postgres.url("missing"))
    except ValueError as e:
        shown = str(e)
    assert shown is not None
    assert "\n" not in shown
    assert 'database "missing" does not exist' in shown
    assert PASSWORD not in shown
    assert "rc%25nt" not in shown


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("postgresql://someone:secret@127.0.0.1:1/x", r"storage postgresql\S+//someone:\*\*\*@127.0.0.1:1/x does not"),
        ("postgresql://someone:sec@secret@host/x", "write an @ in the password as %40"),
        ("postgresql://::::", "is malformed"),
        ("nothing://host/x", "unknown kind"),
        ("study.txt", "is none of postgresql://"),
        ("/proc/nowhere/study.log", "cannot be used as a journal file"),
        ("sqlite:////proc/study.db", "does not answer"),
        ("sqlite:////proc/nowhere/study.db", "does not answer"),
        ("sqlite://", "is in the memory of one process: name a file"),
        ("sqlite:///:memory:", "is in the memory of one process: name a file"),
    ],
)
def test_a_storage_that_cannot_be_used_is_named_in_one_line(url, message):
    begin = time.monotonic()
    with pytest.raises(ValueError, match=message) as caught:
        open_storage(url)
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)
    assert time.monotonic() - begin < 15


def test_a_database_that_another_program_does_not_let_go_of_is_named_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(storages, "LOCK_TIMEOUT", 0.2)
    study = open_quick(f"sqlite:///{tmp_path}/study.db")
    locked = sqlite3.connect(tmp_path / "study.db", isolation_level=None)
    locked.execute("BEGIN EXCLUSIVE")
    with pytest.raises(ValueError, match=r"cannot be used: database is locked$"):
        open_storage(f"sqlite:///{tmp_path}/study.db")
    said = []

    def let_go(text):
        said.append(text)
        if "does not answer" in text:
            locked.execute("ROLLBACK")

    work_quickly(study, lambda trial: 1.0, 1, report=let_go)
    assert said == ["the storage does not answer: trying again for 300 s", "trial 0: 1 (1 of 1 finished)"]


def test_a_lock_that_a_killed_worker_has_left_on_a_journal_is_broken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = open_quick("folder/study.log")
    lock = study._storage._backend._lock
    lock.acquire()  # and is not released
    # Optuna tells its age by what the link points to: without that it would wait for ever.
    assert (tmp_path / "folder" / "study.log.lock").exists()
    lock.grace_period = 0.2
    assert study.ask().number == 0


def test_a_file_that_is_no_journal_is_left_alone(tmp_path):
    path = tmp_path / "training.log"
    path.write_text("epoch 1\n")
    with pytest.raises(ValueError, match="journal file"):
        open_storage(path)
    assert path.read_text() == "epoch 1\n"


@pytest.mark.parametrize(
    ("kwargs", "message"), [(dict(n_trials=0), "n_trials=0"), (dict(grace_period=0.1), "at least twice")]
)
def test_bad_arguments_are_named(kwargs, message):
    study = open_study(optuna.storages.InMemoryStorage(), "s", space={})
    with pytest.raises(ValueError, match=message):
        work_quickly(study, lambda trial: 0.0, **kwargs)
