"""Files that are never half-written, and folders that one process keeps."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_tdpg.common.files import kept_by_this_process as keep
from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.evaluation.animation import Episode, save_animation


def test_two_workers_may_write_the_same_file_at_once(tmp_path):
    path = tmp_path / "summary.md"
    with replaced_atomically(path) as partial:
        partial.write_text("first")
        write_atomically(path, "second")
        assert path.read_text() == "second"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_a_text_is_written_in_utf_8_wherever_it_is_written(tmp_path):
    script = "import sys; from pathlib import Path; from sb3_tdpg.common.files import write_atomically\n"
    script += "write_atomically(Path(sys.argv[1]), '\\u03b2 = 1')"
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run([sys.executable, "-c", script, tmp_path / "page.html"], env=environment, check=True)
    assert (tmp_path / "page.html").read_text(encoding="utf-8") == "β = 1"


EPISODE = Episode([np.zeros((9, 9, 3), np.uint8)] * 2, np.zeros((1, 1)), np.zeros(1))


@pytest.mark.parametrize(("name", "writer", "write"), [
    ("episodes.csv", "pandas.DataFrame.to_csv", lambda path: write_frame_atomically(pd.DataFrame(), path)),
    ("film.gif", "PIL.Image.Image.save", lambda path: save_animation([EPISODE], path, horizon=1, fps=10)),
], ids=["frame", "film"])  # fmt: skip
def test_what_could_not_be_written_leaves_the_old_file_and_nothing_else(name, writer, write, tmp_path, monkeypatch):
    def interrupted(self, target, **kwargs):
        target.write_bytes(b"ne")
        raise KeyboardInterrupt

    path = tmp_path / name
    write_atomically(path, "old")
    monkeypatch.setattr(writer, interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_a_killed_process_has_left_is_removed_an_hour_later_and_nothing_else(tmp_path):
    old, new, other = (tmp_path / f"{name}.partial" for name in ("model.zip.old", "model.zip.new", "model2.zip.old"))
    for folder in (old, new, other):
        folder.mkdir()
    for folder in (old, other):
        os.utime(folder, (0, 0))
    write_atomically(tmp_path / "model.zip", "whole")
    assert {path.name for path in tmp_path.iterdir()} == {"model.zip", new.name, other.name}


def test_content_and_folder_are_flushed_before_and_after_the_file_is_replaced(tmp_path, monkeypatch):
    done = []
    replace = os.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: done.append(Path(f"/proc/self/fd/{descriptor}").resolve().name))
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("replace"), replace(*paths)))
    write_atomically(tmp_path / "summary.md", "text")
    assert done == ["summary.md", "replace", tmp_path.name]


def test_a_folder_is_kept_by_one_process_at_a_time(tmp_path):
    script = (
        "import sys; from pathlib import Path; from sb3_tdpg.common.files import kept_by_this_process\n"
        f"with kept_by_this_process(Path({str(tmp_path / 'out')!r})):\n    print('kept', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdin=-1, stdout=-1, text=True) as process:
        assert process.stdout.readline() == "kept\n"
        with pytest.raises(ValueError, match=r"another process is writing to .*out: wait"), keep(tmp_path / "out"):
            pass
        process.kill()
        process.wait()
        with keep(tmp_path / "out"):
            assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_that_cannot_be_made_is_noticed_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"), keep(tmp_path / "file" / "out"):
        pytest.fail("it was kept")
