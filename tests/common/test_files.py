"""Files that are never half-written."""

import pytest

from sb3_tdpg.common.files import replaced_atomically, write_atomically


def test_two_workers_may_write_the_same_file_at_once(tmp_path):
    path = tmp_path / "summary.md"
    with replaced_atomically(path) as partial:
        partial.write_text("first")
        write_atomically(path, "second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_what_could_not_be_written_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "summary.md"
    write_atomically(path, "old")
    with pytest.raises(KeyboardInterrupt), replaced_atomically(path) as partial:
        partial.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
