"""Run a real PostgreSQL server for the tests, with its data in a temporary folder and on a free port."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest

PASSWORD = "p{e}rc%nt"  # URLs, Optuna and Alembic give some of these characters a special meaning


def find_programs():
    """Return the folder of initdb and pg_ctl, which is not on Debian's PATH."""
    found = shutil.which("pg_ctl")
    folders = [Path(found).resolve().parent] if found else []
    folders += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((f for f in folders if (f / "pg_ctl").exists() and (f / "initdb").exists()), None)


class Postgres:
    """A server that can be stopped and started."""

    def __init__(self):
        self.programs = find_programs()
        if self.programs is None:
            pytest.skip("PostgreSQL is not installed: apt install postgresql")
        self.user = None
        if os.geteuid() == 0:  # PostgreSQL does not run as root
            try:
                pwd.getpwnam("postgres")
            except KeyError:
                pytest.skip("PostgreSQL does not run as root, and there is no user postgres: apt install postgresql")
            self.user = "postgres"
        # pytest's folder is not used, because only its owner has access.
        self.folder = folder = Path(tempfile.mkdtemp(prefix="sb3_tdpg-postgres-"))
        if self.user:
            shutil.chown(folder, self.user, self.user)
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.port = s.getsockname()[1]
        password_file = folder / "password"
        password_file.write_text(PASSWORD)
        if self.user:
            shutil.chown(password_file, self.user)
        self._run("initdb", "-D", self.data, "-U", "tester", "-A", "scram-sha-256", f"--pwfile={password_file}", "-N")

    @property
    def data(self):
        return str(self.folder / "data")

    def url(self, database="postgres"):
        password = PASSWORD.replace("%", "%25").replace("{", "%7B").replace("}", "%7D")
        return f"postgresql://tester:{password}@127.0.0.1:{self.port}/{database}"

    def start(self):
        settings = f"-p {self.port} -c unix_socket_directories='' -h 127.0.0.1 -c fsync=off"
        self._run("pg_ctl", "-D", self.data, "-w", "-l", str(self.folder / "log"), "-o", settings, "start")

    def stop(self):
        self._run("pg_ctl", "-D", self.data, "-m", "immediate", "-w", "stop")

    def create_database(self, name):
        import psycopg

        with psycopg.connect(self.url(), autocommit=True) as connection:
            connection.execute(f"CREATE DATABASE {name}")
        return self.url(name)

    def close(self):
        self.stop()
        shutil.rmtree(self.folder)

    def _run(self, program, *arguments):
        as_user = dict(user=self.user, group=self.user, extra_groups=[]) if self.user else {}
        result = subprocess.run(
            [self.programs / program, *arguments],
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            check=False,
            **as_user,
        )
        assert result.returncode == 0, f"{program} failed: {result.stderr}"


@pytest.fixture(scope="session")
def postgres():
    """Provide a server for all tests of this process."""
    server = Postgres()
    server.start()
    yield server
    server.close()
