"""Workers that share a study: real processes on a real PostgreSQL and on a journal file."""

import re
import time

import pytest

pytest.importorskip("rl_zoo3")

import optuna
from optuna.trial import TrialState
from postgres import PASSWORD, postgres  # noqa: F401
from study_workers import GRACE_PERIOD, Workers, open_quick

from sb3_tdpg.zoo.studies import open_storage, work

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
ALIVE = (TrialState.RUNNING, TrialState.WAITING)


@pytest.fixture(params=["postgresql", "journal"])
def url(request, tmp_path):
    """A storage that has never been used."""
    if request.param == "journal":
        return str(tmp_path / "study.log")
    server = request.getfixturevalue("postgres")
    return server.create_database("d" + re.sub(r"\W", "_", tmp_path.name).lower())


@pytest.fixture
def workers(tmp_path, url):
    made = []

    def make(n_trials):
        made.append(Workers(tmp_path, url, n_trials))
        return made[-1]

    yield make
    for each in made:
        each.stop()


def test_a_trial_whose_worker_is_killed_is_run_again_with_its_parameters(workers, url):
    team = workers(8)
    (victim,) = team.start(60)
    team.wait_for("begin", victim)  # the others might leave nothing to it
    others = team.start(0.1, 0.1)
    team.send("SIGKILL", victim)
    team.join(others)
    trials = open_quick(url).get_trials()
    finished = [t for t in trials if t.state in FINISHED]
    assert 8 <= len(finished) <= 8 + 2
    assert not [t for t in trials if t.state in ALIVE]
    (lost,) = team.lines("begin", victim)
    assert sum((str(t.params["x"]), str(t.params["y"])) == lost for t in finished) == 1
    # No result is lost, and no two workers tried the same point though their samplers have the same seed.
    ended = team.lines("end")
    assert len(set(ended)) == len(finished)
    assert len(ended) - team.n_dropped == len(finished)


def test_ctrl_c_hands_the_trial_to_the_next_worker_at_once(workers, url):
    team = workers(2)
    (first,) = team.start(60)
    team.wait_for("begin", first)
    team.send("SIGINT", first)
    first.join(20)
    assert first.exitcode not in (0, None)

    ran = []

    def objective(trial):
        ran.append((str(trial.suggest_float("x", -1, 1)), str(trial.suggest_float("y", -1, 1))))
        return 0.0

    work(open_quick(url), objective, 2)
    assert len(ran) == 2
    assert ran[:1] == team.lines("begin")


def test_a_worker_that_was_suspended_drops_the_trial_that_was_taken_over_and_goes_on(workers, url):
    team = workers(4)
    (suspended,) = team.start(1.0)
    team.wait_for("begin", suspended)
    team.send("SIGSTOP", suspended)
    team.join(team.start(0.1))
    team.send("SIGCONT", suspended)
    team.join([suspended])
    assert "was taken over by another worker: its result is dropped" in team.said
    finished = [t for t in open_quick(url).get_trials() if t.state in FINISHED]
    assert len(finished) == 4
    (lost,) = team.lines("begin", suspended)
    assert sum((str(t.params["x"]), str(t.params["y"])) == lost for t in finished) == 1


def test_a_worker_that_dies_before_its_first_heartbeat_leaves_a_trial_that_is_run_again(url):
    study, points = open_quick(url), []
    lost = study.ask()
    lost.suggest_float("x", -1, 1)
    time.sleep(GRACE_PERIOD + 0.5)
    work(study, lambda trial: points.append(trial.suggest_float("x", -1, 1)) or 0.0, 1)
    assert points == [lost.params["x"]]


def test_a_trial_outlasts_a_restart_of_the_database(tmp_path, postgres):  # noqa: F811
    team = Workers(tmp_path, postgres.create_database("restarted"), 1)
    try:
        (worker,) = team.start(4 * GRACE_PERIOD)
        team.wait_for("begin", worker)
        postgres.stop()
        time.sleep(1.5)  # at least one heartbeat is lost
        postgres.start()
        time.sleep(1.5 * GRACE_PERIOD)
        (other,) = team.start(0.1)
        team.join([worker, other])
    finally:
        team.stop()
    assert len(team.lines("begin")) == len(team.lines("end")) == 1


def test_a_trial_whose_result_cannot_be_told_in_an_outage_is_run_again(tmp_path, monkeypatch):
    study, said, failures = open_quick(str(tmp_path / "study.log")), [], iter([True])
    tell = study._storage.set_trial_state_values

    def tell_after_an_outage(trial_id, state, values=None):
        if state == TrialState.COMPLETE and next(failures, False):
            raise optuna.exceptions.StorageInternalError("the server is being restarted")
        return tell(trial_id, state, values)

    monkeypatch.setattr(study._storage, "set_trial_state_values", tell_after_an_outage)
    points = []
    work(study, lambda trial: points.append(trial.suggest_float("x", 0, 1)) or 1.0, 1, report=said.append)
    assert len(points) == 2
    assert points[0] == points[1]
    assert "the storage does not answer (the server is being restarted): waiting for it" in said
    assert [t.state for t in study.get_trials() if t.state in FINISHED + ALIVE] == [TrialState.COMPLETE]


def test_a_storage_that_never_answers_again_ends_the_worker(tmp_path, monkeypatch):
    study = open_quick(str(tmp_path / "study.log"))
    monkeypatch.setattr("sb3_tdpg.zoo.studies.PATIENCE", 0.2)

    def fail(*args, **kwargs):
        raise optuna.exceptions.StorageInternalError("it is gone")

    monkeypatch.setattr(study._storage, "get_all_trials", fail)
    with pytest.raises(ValueError, match=r"has not answered for 0\.2 seconds: it is gone"):
        work(study, lambda _: 1.0, 1, report=lambda _: None)


def test_workers_that_start_at_once_run_at_most_one_trial_each_beyond_those_asked_for(workers, url):
    team = workers(2)
    team.join(team.start(*[0.5] * 4))
    n_finished = sum(t.state in FINISHED for t in open_quick(url).get_trials())
    assert 2 <= n_finished == len(team.lines("end")) <= 2 + 4


def test_a_value_error_prunes_the_trial_and_is_kept(url):
    study, said = open_quick(url), []

    def objective(trial):
        if trial.number == 0:
            raise ValueError("rate is too high")
        return float("nan") if trial.number == 1 else 1.0

    work(study, objective, 3, report=said.append)
    trials = study.get_trials()
    assert [t.state for t in trials] == [TrialState.PRUNED, TrialState.PRUNED, TrialState.COMPLETE]
    assert [t.user_attrs.get("reason") for t in trials] == ["rate is too high", "the result is nan", None]
    assert said == [
        "trial 0: pruned: rate is too high (1 of 3 finished)",
        "trial 1: pruned: the result is nan (2 of 3 finished)",
        "trial 2: 1 (3 of 3 finished)",
    ]
    work(study, lambda _: pytest.fail("the study is finished"), 3)


@pytest.mark.parametrize(("error", "n_retries"), [(RuntimeError, 3), (KeyboardInterrupt, 6)])
def test_an_error_ends_the_worker_and_the_trial_is_run_again(error, n_retries, tmp_path):
    study, points = open_quick(tmp_path / "study.log"), []

    def objective(trial):
        points.append(trial.suggest_float("x", 0, 1))
        if len(points) <= n_retries + (error is RuntimeError):
            raise error("out of memory")
        return 0.0

    while len(points) < 1 + n_retries:
        try:
            work(study, objective, 1)
        except error:
            continue
    work(study, objective, 1)
    assert len(set(points[: 1 + n_retries])) == 1
    # A trial that always fails is left, and another one takes its place.
    assert len(set(points)) == (2 if error is RuntimeError else 1)
    assert sum(t.state == TrialState.COMPLETE for t in study.get_trials()) == 1


def test_a_study_with_other_settings_is_refused_and_the_differences_are_named(url):
    open_quick(url, space={"x": [-1, 1], "env": {"id": "Lava-v0", "noise": 0.1}})
    assert open_quick(url, space={"x": (-1, 1), "env": {"id": "Lava-v0", "noise": 0.1}}).user_attrs["space"]
    with pytest.raises(ValueError, match=r"study 's' .* env.noise: 0.1 there, 0.2 here; x: \[-1, 1\] there, not here"):
        open_quick(url, space={"env": {"id": "Lava-v0", "noise": 0.2}})


def test_a_study_of_another_program_is_refused(tmp_path):
    storage = open_storage(tmp_path / "study.log")
    optuna.create_study(storage=storage, study_name="s").optimize(lambda trial: 0.0, n_trials=1)
    with pytest.raises(ValueError, match="study 's' was made by another program"):
        open_quick(tmp_path / "study.log")


def test_a_password_is_neither_shown_nor_an_obstacle(postgres):  # noqa: F811
    open_storage(postgres.url())
    with pytest.raises(ValueError, match='database "missing" does not exist') as caught:
        open_storage(postgres.url("missing"))
    shown = str(caught.value)
    assert "\n" not in shown
    assert PASSWORD not in shown
    assert "rc%25nt" not in shown


@pytest.mark.parametrize(("url", "message"), [
    ("postgresql://someone:secret@127.0.0.1:1/x", r"storage postgresql://someone:\*\*\*@127.0.0.1:1/x cannot"),
    ("postgresql://someone:sec@secret@host/x", "write an @ in the password as %40"),
    ("postgresql://::::", "is malformed or of an unknown kind, expected"),
    ("nothing://host/x", "is malformed or of an unknown kind, expected"),
    ("study.txt", "must be postgresql://"),
    ("sqlite:///study.db", "SQLite is not meant for several workers"),
    ("/proc/nowhere/study.log", "cannot be opened"),
])  # fmt: skip
def test_a_storage_that_cannot_be_used_is_named_in_one_line(url, message):
    begin = time.monotonic()
    with pytest.raises(ValueError, match=message) as caught:
        open_storage(url)
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)
    assert time.monotonic() - begin < 15


def test_a_lock_that_a_killed_worker_has_left_on_a_journal_is_broken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    study = open_quick("folder/study.log")
    lock = study._storage._backend._lock
    lock.acquire()  # and is not released
    # Optuna reads its age from the file that the link points to: otherwise it would wait forever.
    assert (tmp_path / "folder" / "study.log.lock").exists()
    lock.grace_period = 0.2
    assert study.ask().number == 0
