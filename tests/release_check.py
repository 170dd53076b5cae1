"""
Check the files that a release uploads: ``make release-check``.

Build the sdist from the files that git tracks, and the wheel from the sdist, in dist/. Check how PyPI will show them.
Install each of the two in a new environment with its declared dependencies, and train, save and load a model there.
``BORROW=1 make release-check`` uses the dependencies of this environment instead of installing them twice.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"

SMOKE_TEST = """
import importlib.metadata, pathlib, sys

import gymnasium
import sb3_tdpg
from sb3_tdpg import TDPG
from sb3_tdpg.hyperparams import load_hyperparams

assert pathlib.Path(sb3_tdpg.envs.__file__).is_relative_to(sys.prefix), sb3_tdpg.envs.__file__
assert importlib.metadata.version("sb3_tdpg") == sb3_tdpg.__version__
for id in ("Lava-v0", "BallCatch-v0", "PandaGrasp-v0"):
    assert load_hyperparams(id)["policy"] == "TRVPolicy"
    env = gymnasium.make(id)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    env.close()
model = TDPG("TRVPolicy", "Lava-v0", seed=0).learn(1)
model.save("model.zip")
action, state = TDPG.load("model.zip").predict(gymnasium.make("Lava-v0").reset(seed=0)[0])
print(f"sb3_tdpg {sb3_tdpg.__version__} trains, saves and loads on Python {sys.version.split()[0]}")
"""


def run(*command: object, cwd: Path = ROOT) -> str:
    """Run a command without this checkout on its path; if it fails, exit with its output."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    arguments = [str(argument) for argument in command]
    done = subprocess.run(
        arguments, cwd=cwd, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    if done.returncode:
        sys.exit(f"{done.stdout}\nfailed: {' '.join(arguments[:4])} ...")
    return done.stdout


def tracked() -> list[str]:
    """Return the files that git tracks; a file that was not added will also be missing in the release."""
    names = run("git", "ls-files", "-z").split("\0")
    return [name for name in names if (ROOT / name).is_file()]


def build(scratch: Path) -> list[Path]:
    """Build in a copy, because setuptools builds in place and would include files of an old build."""
    files = tracked()
    for name in files:
        (scratch / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, scratch / name)
    shutil.rmtree(DIST, ignore_errors=True)
    run(sys.executable, "-m", "build", "--outdir", DIST, scratch)
    (sdist,) = DIST.glob("*.tar.gz")
    (wheel,) = DIST.glob("*.whl")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    if missing := sorted(set(files) - packed):
        sys.exit(f"missing from {sdist.name}, add them to MANIFEST.in: {', '.join(missing)}")
    return [sdist, wheel]


def check_tag(version: str) -> None:
    """Compare the version with TAG, which the release workflow sets."""
    tag = os.environ.get("TAG")
    if tag and tag != f"v{version}":
        sys.exit(
            f"the tag is {tag}, but sb3_tdpg.__version__ is {version}: tag the release v{version}, or set the "
            "version in sb3_tdpg/__init__.py, setup.cfg and CITATION.cff"
        )


def smoke_test(archive: Path, folder: Path, borrow: bool) -> str:
    """Install the archive in a new environment, and use it from an empty folder."""
    venv.create(folder / "venv", with_pip=True, symlinks=os.name != "nt")
    programs = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    python = programs / ("python.exe" if os.name == "nt" else "python")
    pip = (python, "-m", "pip", "--disable-pip-version-check")
    empty = folder / "empty"
    empty.mkdir()
    if borrow:
        # Folders in a .pth file come last on the path, and the .pth files in them are not read. So the editable install
        # of this checkout is not found.
        packages = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=empty).strip()
        ours = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
        Path(packages, "borrowed.pth").write_text("\n".join(ours))
    run(*pip, "install", "-c", ROOT / "constraints.txt", *(["--no-deps"] if borrow else []), archive, cwd=empty)
    if not borrow:
        run(*pip, "check", cwd=empty)
    run(programs / "sb3-tdpg", "--help", cwd=empty)
    return run(python, "-c", SMOKE_TEST, cwd=empty).splitlines()[-1]


def main() -> None:
    """Build the archives, check and test them; exit at the first error."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--borrow", action="store_true", help="take the dependencies of this environment")
    borrow = parser.parse_args().borrow
    with tempfile.TemporaryDirectory() as scratch:
        archives = build(Path(scratch) / "source")
    print(*(f"built dist/{path.name} ({path.stat().st_size / 1e6:.1f} MB)" for path in archives), sep="\n", flush=True)
    check_tag(archives[1].name.split("-")[1])
    print(run(sys.executable, "-m", "twine", "--no-color", "check", "--strict", *archives), end="", flush=True)
    for archive in archives:
        with tempfile.TemporaryDirectory() as folder:
            print(f"{archive.name}: {smoke_test(archive, Path(folder), borrow)}", flush=True)


if __name__ == "__main__":
    main()
