"""
The Python code of the README, the documentation and its notebooks runs, and all names in the map of the paper exist.
"""

import importlib
import importlib.util
import json
import re
import subprocess
import warnings
from pathlib import Path

import matplotlib
import pytest
from stable_baselines3 import PPO

from sb3_tdpg import TDPG
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.information import ESTIMATORS
from sb3_tdpg.information.critic import CriticEstimator
from sb3_tdpg.robustness import PERTURBATIONS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]

# A block after <!-- no-run --> is run by another test, with Ray or with a fake Hub (distributed/test_ray_vec_env.py,
# hub/test_transfer.py). An indented or quoted block does not count.
BLOCK = re.compile(r"^(?P<skip><!-- no-run -->\n+)?```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
POLICIES = sorted((ROOT / "docs" / "policies").glob("*.zip"))
PAPER_MAP = ROOT / "docs" / "paper_map.md"

# Everything that has a number in the paper's PDF, except sections.
PAPER_NUMBERS = {
    *(f"Equation {i}" for i in range(1, 17)),
    "Theorem II.1",
    *(f"Algorithm {i}" for i in (1, 2)),
    *(f"Footnote {i}" for i in (1, 2)),
    *(f"Table {i}" for i in ("I", "II", "III")),
    *(f"Figure {i}" for i in range(1, 6)),
}

MAX_EPOCHS = 2

# All other pages can take minutes and are marked slow.
QUICK_PAGES = {
    "README.md",
    "docs/guide/quickstart.md",
    "docs/guide/algorithm.md",
    "docs/guide/your_environment.md",
    "docs/guide/extend.md",
    "docs/environments/lava.md",
}


def python_blocks(page):
    """Yield line number and code of each block of a page that this test runs."""
    text = page.read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        if match["skip"] is None:
            yield text.count("\n", 0, match.start("code")) + 1, match["code"]


def name_of(page):
    return str(page.relative_to(ROOT))


@pytest.fixture
def brief_training(monkeypatch):
    """Limit every call of ``learn`` to a few epochs with a few critic steps."""
    learn, learn_ppo, init = TDPG.learn, PPO.learn, CriticEstimator.__init__

    def brief_learn(self, total_timesteps=1_000_000, *args, **kwargs):
        return learn(self, min(total_timesteps, MAX_EPOCHS * self.epoch_size), *args, **kwargs)

    def brief_ppo(self, total_timesteps, *args, **kwargs):
        return learn_ppo(self, min(total_timesteps, MAX_EPOCHS * self.n_steps * self.n_envs), *args, **kwargs)

    def brief_init(self, *args, **kwargs):
        init(self, *args, **{**kwargs, "gradient_steps": 2, "warmup_gradient_steps": 5, "refit_gradient_steps": 5})

    monkeypatch.setattr(TDPG, "learn", brief_learn)
    monkeypatch.setattr(PPO, "learn", brief_ppo)
    monkeypatch.setattr(CriticEstimator, "__init__", brief_init)


@pytest.fixture
def registries(registry):
    """Remove the environments, the perturbations and the estimators that a page registers."""
    before = [(table, dict(table)) for table in (PERTURBATIONS, ESTIMATORS)]
    yield
    for table, entries in before:
        table.clear()
        table.update(entries)


def run_in_order(blocks, source):
    """Run blocks of code, with their line numbers, as one program without warnings; return its namespace."""
    namespace = {"__name__": "__main__"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the code of a page must not give a warning
        # Two warnings are not caused by the page: tqdm.rich, which SB3's progress bar uses, is experimental; and a
        # shortened training may miss its cost limit.
        warnings.filterwarnings("ignore", message="no epoch met cost_limit|the training was too short")
        warnings.filterwarnings("ignore", message="rich is experimental")
        warnings.filterwarnings("ignore", module=r"torch\.")
        for line, code in blocks:
            # Blank lines come first, so that a traceback shows the line number in the page.
            exec(compile("\n" * (line - 1) + code, str(source), "exec"), namespace)
    return namespace


def parameters_of(pages):
    """Return the pages as parameters; pages that take minutes are marked slow."""
    return [pytest.param(p, marks=() if name_of(p) in QUICK_PAGES else pytest.mark.slow, id=name_of(p)) for p in pages]


@pytest.mark.parametrize("page", parameters_of(p for p in PAGES if any(python_blocks(p))))
def test_the_python_blocks_of_a_page_run_in_order(page, tmp_path, monkeypatch, brief_training, registries):
    monkeypatch.chdir(tmp_path)
    run_in_order(python_blocks(page), page)


def test_the_block_pattern_finds_what_the_pages_have():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    blocks, skipped = text.count("\n```python\n"), text.count("<!-- no-run -->")
    assert blocks - skipped == sum(len(list(python_blocks(page))) for page in PAGES) > 10


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_between_pages_point_to_files(page):
    links = re.findall(r"\]\(([^)#:\s]+\.md)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not (page.parent / link).is_file()]
    assert not missing


@pytest.mark.parametrize("policy", POLICIES, ids=lambda path: path.stem)
def test_a_published_policy_loads_and_costs_what_its_page_says(policy):
    page = (policy.parent / "index.md").read_text(encoding="utf-8")
    ((is_return, stated),) = re.findall(rf"`{policy.name}` \| (return )?([\d.]+) \|", page)
    row = Scenario("Training", policy.stem)
    records = evaluate_scenarios(TDPG.load(policy, device="cpu"), [row], n_episodes=200 if is_return else 1000, seed=0)
    mean = -records["cost"].mean() if is_return else records["cost"].mean()
    assert mean == pytest.approx(float(stated), abs=5 if is_return else 0.06)


def code_cells(notebook):
    """Return the code of each cell, in order; a notebook is JSON that contains plain Python."""
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            yield 1, "".join(cell["source"])


@pytest.fixture
def no_window(monkeypatch):
    """Draw figures in memory instead of in a window."""
    backend = matplotlib.get_backend()
    matplotlib.use("Agg")
    yield
    matplotlib.pyplot.close("all")
    matplotlib.use(backend)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_a_notebook_runs_from_top_to_bottom(notebook, tmp_path, monkeypatch, brief_training, no_window):
    monkeypatch.chdir(tmp_path)
    run_in_order(code_cells(notebook), notebook)


def test_the_notebook_installs_the_wheel_beside_it_where_the_package_is_missing(tmp_path, monkeypatch):
    _, first = next(code_cells(ROOT / "docs" / "notebooks" / "quickstart.ipynb"))
    installed = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(subprocess, "check_call", installed.append)
    with pytest.raises(FileNotFoundError, match="make wheel"):
        exec(first, {})
    Path("sb3_tdpg-0.2.0-py3-none-any.whl").touch()
    exec(first, {})
    assert [command[1:4] + command[-1:] for command in installed] == [
        ["-m", "pip", "install", "sb3_tdpg-0.2.0-py3-none-any.whl[plots]"]
    ]


@pytest.mark.slow
def test_the_quickstart_notebook_shows_what_it_says(tmp_path, monkeypatch, no_window):
    monkeypatch.chdir(tmp_path)
    table = run_in_order(code_cells(ROOT / "docs" / "notebooks" / "quickstart.ipynb"), "quickstart.ipynb")["table"]
    ratio = table[table["scenario"] == "Sensor noise 1e0"].set_index("model")["ratio"]
    assert ratio["TDPG"] < 1.05
    assert ratio["policy gradient"] > 5


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_a_notebook_is_kept_without_outputs(notebook):
    content = json.loads(notebook.read_text(encoding="utf-8"))
    assert (content["nbformat"], len(content["cells"]) > 5) == (4, True)
    for cell in content["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == [] and cell["execution_count"] is None


def numbers_of_the_paper(text):
    """Return the numbers that a text cites; "Equations 12 and 13" gives Equation 12 and Equation 13."""
    number = r"(?:[IVX]+\.\d|\d+|[IVX]+)\b"
    kinds = "Equation|Theorem|Algorithm|Footnote|Table|Figure"
    found = set()
    for kind, numbers in re.findall(rf"\b({kinds})s? ({number}(?:(?:, | and ){number})*)", text):
        found |= {f"{kind} {each}" for each in re.split(", | and ", numbers)}
    return found


def test_the_map_of_the_paper_has_a_row_for_every_number_and_no_other_and_each_names_a_test():
    before_the_deviations = PAPER_MAP.read_text(encoding="utf-8").partition("## Where this implementation deviates")[0]
    rows = [line for line in before_the_deviations.splitlines() if line.startswith("| ") and "| tests |" not in line]
    assert len(rows) > 30
    assert numbers_of_the_paper(" ".join(row.split("|")[1] for row in rows)) == PAPER_NUMBERS
    assert not [row for row in rows if "::test_" not in row]


def test_every_function_in_the_map_of_the_paper_can_be_imported():
    roles = re.findall(r"\{(func|class|meth|data)\}`(?:[^`<]*<)?~?([\w.]+)>?`", PAPER_MAP.read_text(encoding="utf-8"))
    assert len(roles) > 40
    for kind, target in roles:
        names = target.split(".")
        depth = 2 if kind == "meth" else 1
        found = importlib.import_module(".".join(names[:-depth]))
        for name in names[-depth:]:
            found = getattr(found, name)


def test_every_test_in_the_map_of_the_paper_is_there():
    named = re.findall(r"`([\w/]+\.py)::(test_\w+)`", PAPER_MAP.read_text(encoding="utf-8"))
    assert len(named) > 60
    missing = [
        f"{file}::{name}"
        for file, name in named
        if f"\ndef {name}(" not in (ROOT / "tests" / file).read_text(encoding="utf-8")
    ]
    assert not missing


def test_numbers_of_the_paper_that_the_code_cites_are_in_the_map():
    sources = [path for folder in ("sb3_tdpg", "envs") for path in sorted((ROOT / folder).rglob("*.py"))]
    texts = [re.sub(r"\s+", " ", path.read_text(encoding="utf-8")) for path in sources]
    assert sum(bool(numbers_of_the_paper(text.replace("equation", "Equation"))) for text in texts) > 5
    for path, text in zip(sources, texts, strict=True):
        unknown = numbers_of_the_paper(text.replace("equation", "Equation")) - PAPER_NUMBERS
        assert not unknown, f"{path}: {unknown}"


def test_the_table_of_defaults_is_that_of_the_presets():
    spec = importlib.util.spec_from_file_location("make_defaults", ROOT / "docs" / "make_defaults.py")
    make_defaults = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make_defaults)
    assert make_defaults.page() == make_defaults.PAGE.read_text(encoding="utf-8"), "run python docs/make_defaults.py"
    assert "| `gae_lambda` | 0.3 | 0.95 | 0.95 | 0.95 |" in make_defaults.page()
