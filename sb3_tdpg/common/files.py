"""Write files atomically, and keep a folder for one process."""

import glob
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

SECONDS_UNTIL_LOCKED = 10.0  # a folder is locked a moment after it was made


def write_atomically(path: Path, text: str) -> None:
    """Write a text file atomically: readers never see a partial file."""
    with replaced_atomically(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def replaced_atomically(path: Path) -> Iterator[Path]:
    """
    Give a path to write to; it replaces the target when the block ends without an error.

    Folders are made. Several processes may replace a target at once. After a power cut there is the old or the new
    content, never a part of it; what a killed process has left is removed the next time.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f"{glob.escape(path.name)}.*.partial"):
        with suppress(OSError), _locked(left):  # not there any more, or somebody writes
            if time.time() - left.stat().st_mtime > SECONDS_UNTIL_LOCKED:
                shutil.rmtree(left)
    # In a folder of its own: a compressed file contains its name, which must not vary.
    with TemporaryDirectory(prefix=f"{path.name}.", suffix=".partial", dir=path.parent) as folder, ExitStack() as stack:
        with suppress(OSError):  # not every system can lock a folder
            stack.enter_context(_locked(Path(folder)))
        partial = Path(folder, path.name)
        try:
            yield partial
        except OSError as e:  # of a full disk
            if e.errno is not None and e.filename is None:
                e.filename = str(path)
            raise
        for written in [partial, *partial.rglob("*")] if partial.is_dir() else [partial]:
            _flush(written)
        os.replace(partial, path)
        _flush(path.parent)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder until the block ends or this process does; an ``OSError`` if another process has locked it."""
    if fcntl is None:
        raise OSError("this system cannot lock a folder")
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _flush(path: Path) -> None:
    """Wait until a file, or the list of files of a folder, is on the disk."""
    with suppress(OSError):  # not every system can flush a folder
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def kept_by_this_process(folder: Path) -> Iterator[None]:
    """
    Make a folder of results, and keep other processes out of it until the block ends or this process does.

    A new folder that is still empty then is removed, with the new folders above it.

    :raises ValueError: if another process keeps it.
    :raises OSError: if the folder cannot be written to.
    """
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".writable", dir=folder):
        pass
    with ExitStack() as stack:
        if fcntl is not None:
            try:
                stack.enter_context(_locked(folder))
            except BlockingIOError as e:
                raise ValueError(f"another process is writing to {folder}: wait for it, or give another folder") from e
        try:
            yield
        finally:
            with suppress(OSError):  # not empty
                for path in new:
                    path.rmdir()
