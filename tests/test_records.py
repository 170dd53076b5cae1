"""``make records`` packs the records of single episodes that have a checksum, and rejects records that differ."""

import importlib.util
import tarfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("make_records", ROOT / "docs" / "make_records.py")
make_records = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(make_records)


@pytest.fixture
def results(tmp_path):
    """Return a folder with two records, a summary (which is not a record), and checksums."""
    folder = tmp_path / "results"
    (folder / "lava").mkdir(parents=True)
    for name in ("episodes_text.csv.gz", "shifts.csv.xz", "seeds.csv"):
        (folder / "lava" / name).write_bytes(name.encode())
    (folder / make_records.CHECKSUMS).write_text("# where they are\n")
    make_records.update(folder)
    return folder


def test_the_records_are_packed_with_the_same_bytes_twice(results, tmp_path):
    one, two = tmp_path / "one.tar", tmp_path / "two.tar"
    make_records.pack(results, one)
    (results / "lava" / "shifts.csv.xz").touch()
    make_records.pack(results, two)
    assert one.read_bytes() == two.read_bytes()
    with tarfile.open(one) as tar:
        assert tar.getnames() == ["lava/episodes_text.csv.gz", "lava/shifts.csv.xz"]
        assert tar.extractfile("lava/shifts.csv.xz").read() == b"shifts.csv.xz"


@pytest.mark.parametrize(("content", "message"), [
    (None, "lava/shifts.csv.xz is missing"),
    (b"damaged", "lava/shifts.csv.xz differs from its checksum"),
])  # fmt: skip
def test_a_record_that_is_missing_or_damaged_is_named_and_nothing_is_packed(results, tmp_path, content, message):
    path = results / "lava" / "shifts.csv.xz"
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        make_records.pack(results, tmp_path / "records.tar")
    assert "# where they are" in str(error.value)
    assert not (tmp_path / "records.tar").exists()


def test_an_update_takes_new_records_and_keeps_the_checksums_of_those_that_are_elsewhere(results, tmp_path):
    comments, before = make_records.read_checksums(results)
    (results / "lava" / "shifts.csv.xz").unlink()
    (results / "lava" / "random.csv.xz").write_bytes(b"new")
    with pytest.raises(ValueError, match=r"lava/random\.csv\.xz has no checksum"):
        make_records.pack(results, tmp_path / "records.tar")
    make_records.update(results)
    assert make_records.read_checksums(results) == (comments, {**before, **make_records.found(results)})


def test_records_are_not_tracked_and_those_of_this_folder_are_the_ones_of_the_checksums():
    _, digests = make_records.read_checksums(make_records.RESULTS)
    assert len(digests) == 10
    assert make_records.found(make_records.RESULTS).items() <= digests.items()
