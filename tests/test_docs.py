"""The Python of the README and of the documentation runs, page by page."""

import re
import warnings
from pathlib import Path

import gymnasium as gym
import pytest

from sb3_tdpg import TDPG
from sb3_tdpg.information import CriticEstimator
from sb3_tdpg.robustness import PERTURBATIONS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)]

# A block after <!-- no-run --> is not run; what stands in an indented or quoted block is not one.
BLOCK = re.compile(r"^(?P<skip><!-- no-run -->\n+)?```python\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)

MAX_EPOCHS = 2


def python_blocks(page):
    """Line number and code of each block of a page that is to be run."""
    text = page.read_text(encoding="utf-8")
    for match in BLOCK.finditer(text):
        if match["skip"] is None:
            yield text.count("\n", 0, match.start("code")) + 1, match["code"]


def name_of(page):
    return str(page.relative_to(ROOT))


@pytest.fixture
def brief_training(monkeypatch):
    """Make every call of ``learn`` take a few epochs with a few critic steps, whatever the page asks for."""
    learn, init = TDPG.learn, CriticEstimator.__init__

    def brief_learn(self, total_timesteps=1_000_000, *args, **kwargs):
        return learn(self, min(total_timesteps, MAX_EPOCHS * self.n_episodes * self.horizon), *args, **kwargs)

    def brief_init(self, *args, **kwargs):
        init(self, *args, **{**kwargs, "gradient_steps": 2, "warmup_gradient_steps": 5, "refit_gradient_steps": 5})

    monkeypatch.setattr(TDPG, "learn", brief_learn)
    monkeypatch.setattr(CriticEstimator, "__init__", brief_init)


@pytest.fixture
def registry(monkeypatch):
    """Forget the environments and the perturbations that a page registers."""
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    perturbations = dict(PERTURBATIONS)
    yield
    PERTURBATIONS.clear()
    PERTURBATIONS.update(perturbations)


@pytest.mark.parametrize("page", [p for p in PAGES if any(python_blocks(p))], ids=name_of)
def test_the_python_blocks_of_a_page_run_in_order(page, tmp_path, monkeypatch, brief_training, registry):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "__main__"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what a page shows must not warn
        # Not of the page's making: tqdm.rich, which SB3's progress bar uses, calls itself experimental.
        warnings.filterwarnings("ignore", message="rich is experimental")
        warnings.filterwarnings("ignore", module=r"torch\.")
        for line, code in python_blocks(page):
            # Blank lines in front, so that a traceback shows the line of the page.
            exec(compile("\n" * (line - 1) + code, str(page), "exec"), namespace)


def test_the_block_pattern_finds_what_the_pages_have():
    blocks = sum(page.read_text(encoding="utf-8").count("\n```python\n") for page in PAGES)
    skipped = sum(page.read_text(encoding="utf-8").count("<!-- no-run -->") for page in PAGES)
    assert blocks - skipped == sum(len(list(python_blocks(page))) for page in PAGES) > 10


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_between_pages_point_to_files(page):
    links = re.findall(r"\]\(([^)#:\s]+\.md)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    missing = [link for link in links if not (page.parent / link).is_file()]
    assert not missing
