"""Write files atomically."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


def write_atomically(path: Path, text: str) -> None:
    """Write a text file atomically: readers never see a partial file."""
    with replaced_atomically(path) as partial:
        partial.write_text(text)


@contextmanager
def replaced_atomically(path: Path) -> Iterator[Path]:
    """
    Give a path to write to; it replaces the target when the block ends without an error.

    :param path: The target; folders are made. Several processes may replace it at once.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # In a folder of its own: a compressed file contains its name, which must not vary.
    with TemporaryDirectory(prefix=f"{path.name}.", suffix=".partial", dir=path.parent) as folder:
        partial = Path(folder, path.name)
        yield partial
        os.replace(partial, path)
