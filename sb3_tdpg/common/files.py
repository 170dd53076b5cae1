"""Files that are never half-written."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


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
    # In a folder of its own, since a compressed file tells its name: that must not differ from one time to the next.
    with TemporaryDirectory(prefix=f"{path.name}.", suffix=".partial", dir=path.parent) as folder:
        partial = Path(folder, path.name)
        yield partial
        os.replace(partial, path)
