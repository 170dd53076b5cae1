"""Files that are never half-written."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write_atomically(path: Path, text: str) -> None:
    """Write a text file so that at no time a half-written one is there."""
    with replaced_atomically(path) as partial:
        partial.write_text(text)


@contextmanager
def replaced_atomically(path: Path) -> Iterator[Path]:
    """
    Give a file to write to, which takes the place of another one when it is whole.

    :param path: The file that is replaced, also by several workers at once.
    """
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
