"""
Check the records of single episodes and pack them for a release: ``make records``.

The repository contains summaries, seeds, configurations and pictures of the results. It also contains the checksums of
the records, in ``docs/results/records.sha256``. The records themselves are in one file of a release, which is unpacked
in ``docs/results``. After a study is published again, ``python docs/make_records.py --update`` writes the checksums of
its new records.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
import tarfile
from pathlib import Path

from sb3_tdpg import __version__

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
CHECKSUMS = "records.sha256"
PATTERNS = ("episodes*.csv.*", "shifts.csv.*", "random.csv.*", "nuisance.csv.*")  # as in .gitignore


def read_checksums(results: Path) -> tuple[list[str], dict[str, str]]:
    """Return the comments in the file of checksums, and the checksum of each path in the folder of results."""
    lines = (results / CHECKSUMS).read_text(encoding="utf-8").splitlines()
    pairs = [line.split("  ", 1) for line in lines if line and not line.startswith("#")]
    return [line for line in lines if line.startswith("#")], {name: digest for digest, name in pairs}


def found(results: Path) -> dict[str, str]:
    """Return the checksum of every record in the folder."""
    paths = {path for pattern in PATTERNS for path in results.glob(f"*/{pattern}")}
    return {path.relative_to(results).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def update(results: Path) -> None:
    """Write the checksums of the records in the folder; the checksums of all other records do not change."""
    comments, digests = read_checksums(results)
    digests.update(found(results))
    lines = [f"{digest}  {name}" for name, digest in sorted(digests.items())]
    (results / CHECKSUMS).write_text("\n".join([*comments, *lines, ""]), encoding="utf-8")


def pack(results: Path, target: Path) -> None:
    """
    Write all records to a tar file; the same records always give the same bytes.

    :raises ValueError: if a record is missing, differs from its checksum or has no checksum; no file is written.
    """
    comments, digests = read_checksums(results)
    there = found(results)
    said = [f"{name} is missing" for name in sorted(digests.keys() - there.keys())]
    said += [f"{name} has no checksum" for name in sorted(there.keys() - digests.keys())]
    said += [
        f"{name} differs from its checksum"
        for name in sorted(digests)
        if there.get(name, digests[name]) != digests[name]
    ]
    if said:
        raise ValueError(
            "\n".join([f"the records in {results} are not those of {CHECKSUMS}:", *said, *comments,
                       "If a study was published again, `python docs/make_records.py --update` takes its records."])
        )  # fmt: skip
    target.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(target, "w", format=tarfile.PAX_FORMAT) as tar:  # the members are already compressed
        for name in sorted(digests):
            member = tarfile.TarInfo(name)
            member.size, member.mode = (results / name).stat().st_size, 0o644
            with (results / name).open("rb") as content:
                tar.addfile(member, content)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true", help="write the checksums of the records in the folder")
    if parser.parse_args().update:
        update(RESULTS)
    target = ROOT / "dist" / f"sb3_tdpg-records-{__version__}.tar"
    try:
        pack(RESULTS, target)
    except ValueError as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    size = target.stat().st_size / 1e6
    print(f"{target.relative_to(ROOT)} has {len(read_checksums(RESULTS)[1])} records, {size:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
