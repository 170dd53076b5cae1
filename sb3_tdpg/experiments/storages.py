"""Where a study is kept: a database that any number of machines reach, or a file."""

from __future__ import annotations

import logging
import os
import random
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy as sa
from optuna.storages import BaseStorage, JournalStorage, RDBStorage
from optuna.storages.journal import JournalFileBackend

CONNECT_TIMEOUT = 10  # seconds
FORMS = "postgresql://user:password@host/database, sqlite:///file.db, or a path that ends in .log"
# Optuna makes its tables in several steps, which workers that start at once disturb.
ATTEMPTS = 10
LOCK_TIMEOUT = 60  # seconds for which another worker may hold SQLite's lock


def open_storage(url: str | os.PathLike[str]) -> BaseStorage:
    """
    Open what any number of workers share; a database without tables gets them, a file that is not there is made.

    :param url: ``postgresql://user:password@host:port/database`` (psycopg 3, unless the URL names another driver), any
        other URL that SQLAlchemy knows (``sqlite:///file.db``), or a path that ends in ``.log``: a journal file, as
        rl-zoo3 has it, which processes that share a file system can use.
    :raises ValueError: if it is malformed, or nothing answers within seconds.
    :raises ImportError: if the driver of the database is not installed.
    """
    text = os.fspath(url)
    if "://" not in text:
        if not text.endswith(".log"):
            raise ValueError(f"storage={text!r} is none of {FORMS}")
        return _open_journal(Path(text))
    parsed = _parse(text)
    shown = parsed.render_as_string(hide_password=True)
    connect_args = _connect_args(parsed)
    if parsed.get_backend_name() == "sqlite":
        if parsed.database in (None, "", ":memory:"):
            raise ValueError(f"storage={text!r} is in the memory of one process: name a file, sqlite:///file.db")
        _make_folder(Path(str(parsed.database)), shown)
    _check_answers(parsed, connect_args, shown)
    # A restarted database must not break the connections that wait in the pool. Optuna formats the URL.
    options = dict(pool_pre_ping=True, connect_args=connect_args)
    plain = parsed.render_as_string(hide_password=False).replace("{", "{{").replace("}", "}}")
    deadline = time.monotonic() + LOCK_TIMEOUT
    for attempt in range(ATTEMPTS):
        try:
            storage = RDBStorage(plain, engine_kwargs=options)
            if parsed.get_backend_name() == "sqlite":
                _lock_before_reading(storage.engine)
            return optuna.storages.get_storage(storage)
        except RuntimeError as e:  # its tables are of another version of Optuna
            raise ValueError(f"storage {shown}: {_one_line(e)}") from e
        except (sa.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError, AssertionError) as e:
            if attempt == ATTEMPTS - 1 or time.monotonic() > deadline:
                reason = _one_line(getattr(e, "orig", None) or e)
                raise ValueError(f"storage {shown} answers, but cannot be used: {reason}") from e
            time.sleep(random.uniform(0.1, 0.5))
    raise AssertionError("not reached")


def _parse(text: str) -> sa.URL:
    try:
        parsed = sa.make_url(text)
    except (sa.exc.ArgumentError, ValueError) as e:
        raise ValueError(f"storage={_without_password(text)!r} is malformed, expected {FORMS}") from e
    if "@" in (parsed.host or ""):
        raise ValueError(f"storage={_without_password(text)!r}: write an @ in the password as %40")
    if parsed.drivername in ("postgresql", "postgres"):
        parsed = parsed.set(drivername="postgresql+psycopg")
    return parsed


def _connect_args(url: sa.URL) -> dict[str, Any]:
    if url.get_backend_name() == "sqlite":
        return dict(timeout=LOCK_TIMEOUT)
    limits = dict(connect_timeout=CONNECT_TIMEOUT)
    # A line that is cut in silence must not hold a worker for the hours that an operating system takes to notice.
    alive = dict(keepalives_idle=30, keepalives_interval=10, keepalives_count=3, tcp_user_timeout=60_000)
    if url.drivername in ("postgresql+psycopg", "postgresql+psycopg2"):
        return {**limits, **alive}
    return limits if url.get_backend_name() == "mysql" else {}


def _lock_before_reading(engine: sa.Engine) -> None:
    """
    Let each transaction take SQLite's lock at its beginning.

    Optuna reads the state of a trial and then sets it, and relies on SELECT ... FOR UPDATE in between, which SQLite
    does not have: two workers could both take the same waiting trial, and a failure could overwrite a result.
    """

    @sa.event.listens_for(engine, "connect")
    def leave_transactions_to_us(connection: Any, _: Any) -> None:
        connection.isolation_level = None

    @sa.event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    engine.dispose()  # the connections that were opened without it


def _make_folder(path: Path, shown: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ValueError(f"storage {shown} does not answer: {_one_line(e)}") from e


def _check_answers(url: sa.URL, connect_args: dict[str, Any], shown: str) -> None:
    try:
        engine = sa.create_engine(url, connect_args=connect_args, poolclass=sa.pool.NullPool)
        with engine.connect() as connection:
            connection.execute(sa.text("SELECT 1"))
    except ImportError as e:
        mend = "pip install sb3_tdpg[postgres]" if e.name == "psycopg" else "install it, or name another one"
        raise ImportError(f"storage {shown} needs the driver {e.name}: {mend}") from e
    except sa.exc.NoSuchModuleError as e:
        raise ValueError(f"storage={shown!r} is of an unknown kind, expected {FORMS}") from e
    except (sa.exc.SQLAlchemyError, ValueError, TypeError) as e:
        raise ValueError(f"storage {shown} does not answer: {_one_line(getattr(e, 'orig', None) or e)}") from e


def _open_journal(path: Path) -> BaseStorage:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        first = path.read_bytes()[:1] if path.exists() else b""
        if first not in (b"", b"{"):
            raise ValueError("it does not begin as one")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            # Whole: a worker that dies with the lock leaves a link to this path, by which the others see its age.
            return JournalStorage(JournalFileBackend(str(path.absolute())))
    except (OSError, ValueError, KeyError, AssertionError) as e:
        raise ValueError(f"storage={str(path)!r} cannot be used as a journal file of Optuna: {_one_line(e)}") from e


@contextmanager
def told_in_one_line() -> Iterator[None]:
    """Turn what Optuna raises when a storage is away into a ``ValueError`` that says so."""
    try:
        yield
    except optuna.exceptions.StorageInternalError as e:
        raise ValueError(f"the storage does not answer: {_one_line(getattr(e.__cause__, 'orig', None) or e)}") from e


def _without_password(text: str) -> str:
    """Hide what stands before the last @ of a URL that cannot be parsed."""
    scheme, _, rest = text.partition("://")
    return f"{scheme}://***@{rest.rpartition('@')[2]}" if "@" in rest else text


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def quiet_optuna() -> None:
    """Leave the messages to us: Optuna's say of every trial what ours say, too."""
    optuna.logging.set_verbosity(logging.WARNING)
