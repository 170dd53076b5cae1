"""Write files atomically, and lock a folder for one process."""

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

SECONDS_UNTIL_ABANDONED = 3600.0  # writing a file takes less


def write_atomically(path: Path, text: str) -> None:
    """Write a text file atomically: readers never see a partial file."""
    with replaced_atomically(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def replaced_atomically(path: Path) -> Iterator[Path]:
    """
    Yield a temporary path; the file written there replaces the target when the block ends without an error.

    Missing folders are created. Several processes may replace the same target at once. After a power cut the target has
    the old or the new content, never a part of it. Temporary files of a killed process are removed by the first
    write to the same target that begins an hour later or more.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f"{glob.escape(path.name)}.*.partial"):
        with suppress(OSError):  # another process has removed the folder
            if time.time() - left.stat().st_mtime > SECONDS_UNTIL_ABANDONED:
                shutil.rmtree(left)
    # The path is in a separate folder, because a compressed file contains its own name, which must not vary.
    with TemporaryDirectory(prefix=f"{path.name}.", suffix=".partial", dir=path.parent) as folder:
        partial = Path(folder, path.name)
        yield partial
        for written in [partial, *partial.rglob("*")] if partial.is_dir() else [partial]:
            _flush(written)
        os.replace(partial, path)
        _flush(path.parent)


def _flush(path: Path) -> None:
    """Wait until the content of a file, or the file list of a folder, is written to the disk."""
    with suppress(OSError):  # not every system can flush a folder
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextmanager
def kept_by_this_process(folder: Path) -> Iterator[None]:
    """
    Create a folder for results, and keep other processes out of it until the block or this process ends.

    Only processes that call this function are kept out, and none on Windows.

    A new folder that is still empty at the end is removed, together with the new folders above it.

    :raises ValueError: if another process has locked the folder.
    :raises OSError: if the folder cannot be written to.
    """
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".writable", dir=folder):
        pass
    with ExitStack() as stack:
        if fcntl is not None:
            descriptor = os.open(folder, os.O_RDONLY)
            stack.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as e:
                raise ValueError(f"another process is writing to {folder}: wait for it, or give another folder") from e
        try:
            yield
        finally:
            with suppress(OSError):  # not empty
                for path in new:
                    path.rmdir()
