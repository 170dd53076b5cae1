"""The package works for a user: built, installed alone in a new environment, and used from another folder."""

import os
import re
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCES = ("sb3_tdpg", "envs", "hyperparams", "setup.cfg", "pyproject.toml", "LICENSE")

IMPORT_ALL = "import sb3_tdpg, sb3_tdpg.envs, sb3_tdpg.hyperparams; "
# Files and folders beside the package in a checkout are not part of it.
NOTHING_ELSE = (
    "import importlib.util; "
    "found = [n for n in ('tests', 'docs', 'sb3_tdpg') if importlib.util.find_spec(f'sb3_tdpg.{n}')]; "
    "assert not found, found; "
)
MAKE_LAVA = "import gymnasium, sb3_tdpg; [gymnasium.make(id).reset() for id in ('Lava-v0', 'sb3_tdpg:Lava-v0')]"


def run(*command: object, cwd: Path, pythonpath: Path | None = None, path: Path | None = None) -> str:
    """Run a command without this checkout in its environment; if it fails, show its output."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    if path is not None:
        environment["PATH"] = f"{path}{os.pathsep}{environment['PATH']}"
    if pythonpath is not None:
        environment["PYTHONPATH"] = str(pythonpath)
    arguments = [str(argument) for argument in command]
    done = subprocess.run(arguments, cwd=cwd, env=environment, text=True, capture_output=True)
    assert done.returncode == 0, f"{' '.join(arguments)}\n{done.stdout}{done.stderr}"
    return done.stdout


def pip(*arguments: object, cwd: Path) -> None:
    """Call pip without the network; the extra `tests` has installed setuptools."""
    run(sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments, cwd=cwd)


def copy_sources(folder: Path) -> Path:
    """Copy the files for a build, because setuptools builds in place and would include an old build/."""
    folder.mkdir()
    for name in SOURCES:
        source = REPOSITORY / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder)
    return folder


def make_environment(folder: Path) -> Path:
    """Create a virtual environment that uses our dependencies, and return its interpreter.

    A folder in a .pth file comes after the environment's own packages, and the .pth files inside it are not read. So
    the dependencies are available without a second installation, but the editable install of this checkout is not.
    """
    venv.create(folder, symlinks=os.name != "nt")
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    packages = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder).strip()
    borrowed = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    Path(packages, "borrowed.pth").write_text("\n".join(borrowed))
    return python


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = copy_sources(folder / "source")
    pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, source, cwd=folder)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the interpreter of an environment in which the wheel is installed."""
    folder = tmp_path_factory.mktemp("installed")
    python = make_environment(folder / "venv")
    pip("--python", python, "install", "--no-deps", wheel, cwd=folder)
    return python


def test_the_wheel_holds_every_module_template_and_hyperparameter_file_and_nothing_else(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {"sb3_tdpg/py.typed", "sb3_tdpg/hub/card.md"}
    expected |= {f"sb3_tdpg/{path.relative_to(REPOSITORY)}" for path in REPOSITORY.glob("envs/**/*.py")}
    expected |= {f"sb3_tdpg/{path.relative_to(REPOSITORY)}" for path in REPOSITORY.glob("hyperparams/*.yml")}
    expected |= {str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob("sb3_tdpg/**/*.py")}
    expected |= {str(path.relative_to(REPOSITORY)) for path in REPOSITORY.glob("sb3_tdpg/**/templates/*")}
    assert any(name.endswith(".yml") for name in expected)
    assert "sb3_tdpg/report/templates/report.md" in expected
    assert expected <= names, f"missing from the wheel: {sorted(expected - names)}"
    assert {name.split("/")[0] for name in names if ".dist-info/" not in name} == {"sb3_tdpg"}


def test_the_installed_wheel_makes_lava_from_its_own_files_and_tells_its_version(
    installed: Path, tmp_path: Path
) -> None:
    show = (
        "import importlib.metadata; print(sb3_tdpg.__file__, sb3_tdpg.envs.__file__, sb3_tdpg.hyperparams.__file__, "
        "importlib.metadata.version('sb3_tdpg'), sb3_tdpg.__version__, sep='\\n')"
    )
    code = IMPORT_ALL + NOTHING_ELSE + MAKE_LAVA + "; " + show
    *files, packaged, reported = run(installed, "-c", code, cwd=tmp_path).splitlines()[-5:]
    assert all(Path(file).is_relative_to(installed.parents[1]) for file in files), files
    assert packaged == reported


def test_the_installed_wheel_does_not_get_in_the_way_of_a_checkout(installed: Path) -> None:
    output = run(installed, "-c", IMPORT_ALL + "print(sb3_tdpg.envs.__file__)", cwd=REPOSITORY)
    assert Path(output.splitlines()[-1]) == REPOSITORY / "envs" / "__init__.py"


def test_a_checkout_on_the_python_path_works_without_an_install(tmp_path: Path) -> None:
    python = make_environment(tmp_path / "venv")
    run(python, "-c", IMPORT_ALL + NOTHING_ELSE + MAKE_LAVA, cwd=tmp_path, pythonpath=REPOSITORY)


QUICKSTART_MAKES = (
    "tdpg_lava.onnx",
    "models/ppo_1.zip",
    "results/report-CartPole-v1/report.html",
    "ball.gif",
    "logs/tdpg/Lava-v0_1/Lava-v0.zip",
)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "end", "makes"), [
    ("README.md", "## Install", ("tdpg_squeeze.zip", "results/report-ppo/report.html")),
    ("docs/guide/quickstart.md", "## In a notebook", QUICKSTART_MAKES),
])  # fmt: skip
def test_the_blocks_of_a_first_page_chain_word_for_word(
    page: str, end: str, makes: tuple[str, ...], installed: Path, tmp_path: Path
) -> None:
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```(python|bash)\n(.*?)^```$", text[: text.index(end)], re.MULTILINE | re.DOTALL)
    assert {language for language, _ in blocks} == {"python", "bash"}
    for language, code in blocks:
        program = (installed, "-c") if language == "python" else ("bash", "-e", "-c")
        print(run(*program, code, cwd=tmp_path, path=installed.parent))
    for made in makes:
        assert (tmp_path / made).stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["lenient", "strict"])
def test_an_editable_install_works_from_inside_and_outside_the_checkout(mode: str, tmp_path: Path) -> None:
    checkout = copy_sources(tmp_path / "checkout")
    python = make_environment(tmp_path / "venv")
    arguments = ["--no-deps", "--no-build-isolation", "--config-settings", f"editable_mode={mode}"]
    pip("--python", python, "install", *arguments, "-e", checkout, cwd=tmp_path)
    for cwd in (tmp_path, checkout):
        run(python, "-c", IMPORT_ALL + NOTHING_ELSE + MAKE_LAVA, cwd=cwd)
