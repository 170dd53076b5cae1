"""The files for GitHub, Read the Docs and newcomers are valid, and everything that they name exists."""

import configparser
import re
from pathlib import Path

import pytest
import yaml

import sb3_tdpg

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
PAGES = sorted((ROOT / ".github").glob("*.md"))
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))

# A call of make with targets and variables, but without other shell commands.
MAKE = re.compile(r"""(?:[A-Z_]+=\S+ )?make(?: [a-z-]+| [A-Z]+=(?:[\w,./]+|"\$READTHEDOCS_OUTPUT/html"))+""")


def read_yaml(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def targets_of(command):
    return {word for word in command.split("make ", 1)[1].split() if "=" not in word}


def jobs_of(workflow):
    return read_yaml(workflow)["jobs"]


@pytest.fixture(scope="module")
def metadata():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    return config["metadata"]


def test_there_are_workflows_and_community_files_to_check() -> None:
    assert {path.stem for path in WORKFLOWS} == {"checks", "release"}
    assert {path.stem for path in PAGES} >= {"CONTRIBUTING", "CODE_OF_CONDUCT", "SECURITY", "PULL_REQUEST_TEMPLATE"}


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_runs_targets_of_the_makefile_and_nothing_else(workflow: Path) -> None:
    steps = [step for job in jobs_of(workflow).values() for step in job.get("steps", [])]
    commands = [step["run"] for step in steps if "run" in step]
    assert commands
    for command in commands:
        assert MAKE.fullmatch(command.strip()), f"not a call of make: {command}"
        assert targets_of(command) <= TARGETS, f"no such target: {command}"


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_may_read_the_repository_and_only_publishing_asks_for_more(workflow: Path) -> None:
    assert read_yaml(workflow)["permissions"] == {"contents": "read"}
    asks = {name for name, job in jobs_of(workflow).items() if "permissions" in job}
    assert asks <= {"publish"}


def test_the_tests_run_on_every_python_of_the_classifiers_and_on_three_systems(metadata) -> None:
    matrix = jobs_of(ROOT / ".github/workflows/checks.yml")["tests"]["strategy"]["matrix"]
    classifiers = re.findall(r"Python :: (3\.\d+)", metadata["classifiers"])
    assert matrix["python"] == classifiers
    assert [name.split("-")[0] for name in matrix["os"]] == ["ubuntu", "macos", "windows"]


def test_a_release_is_published_only_after_every_check() -> None:
    jobs = jobs_of(ROOT / ".github/workflows/release.yml")
    assert set(jobs["publish"]["needs"]) == {"checks", "build"}
    assert jobs["checks"]["uses"] == "./.github/workflows/checks.yml"
    commands = [step["run"] for job in jobs_of(WORKFLOWS[0]).values() for step in job["steps"] if "run" in step]
    ran = set().union(*(targets_of(command) for command in commands))
    assert {"lint", "type", "test", "docs", "release-check"} <= ran


def test_read_the_docs_calls_the_makefile() -> None:
    build = read_yaml(ROOT / ".readthedocs.yaml")["build"]["jobs"]
    for command in [*build["install"], *build["build"]["html"]]:
        assert MAKE.fullmatch(command), f"not a call of make: {command}"
        assert targets_of(command) <= TARGETS, f"no such target: {command}"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_a_community_page_links_to_files_and_names_targets_that_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if not link.startswith("https://")]
    missing = [link for link in links if not (page.parent / link).is_file()]
    assert not missing
    for command in re.findall(r"`make ([a-z -]+)`", text):
        assert set(command.split()) <= TARGETS, f"no such target: make {command}"


def test_the_citation_and_setup_cfg_have_the_version_of_the_package(metadata) -> None:
    citation = read_yaml(ROOT / "CITATION.cff")
    assert citation["version"] == metadata["version"] == sb3_tdpg.__version__


def test_the_citation_prefers_the_paper_that_the_readme_cites() -> None:
    paper = read_yaml(ROOT / "CITATION.cff")["preferred-citation"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"{{{paper['title']}}}" in readme
    assert all(author["family-names"] in readme for author in paper["authors"])
