"""
Mutation testing: ``make mutants`` makes small changes to the code and counts the changes that the tests detect.

The code that computes the results is changed: the losses, the update, the estimators of the information, the
certificates and the environments. ``mutmut`` changes one operator, number or argument at a time. It then runs the tests
that reach the changed function until one fails. Errors, warnings, and code that draws pictures or writes a page are not
changed. By default a random sample of 400 changes is tried, which takes an hour; ``--all`` tries all of them, which
takes a day. A run that was stopped continues where it stopped.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

from scipy.stats import binomtest

from sb3_tdpg.common.threads import usable_cores

ROOT = Path(__file__).resolve().parents[1]
TREE = ROOT / "build" / "mutants"
GOAL = 0.9
CODE = [
    "losses.py", "advantages.py", "auto_weight.py", "buffers.py", "features.py", "common/running_norms.py",
    "episodic.py", "tdpg.py", "information/*.py", "robustness/families.py", "evaluation/interval.py",
    "evaluation/interval_bounds.py", "certificates/certificate.py", "certificates/declared.py",
    "certificates/shifts.py", "envs/*.py",
]  # fmt: skip
# Code for pictures, and the table of scenarios, which is made at import, before mutmut activates a change.
LEFT_OUT = re.compile(r"\.scenarios\.|SideView|render__|_figure__")
TESTS = [
    "test_losses.py", "test_advantages.py", "test_gradients.py", "test_reference_loop.py", "test_buffers.py",
    "test_passes.py", "test_presets.py", "test_tdpg.py", "test_bad_input.py", "test_auto_weight.py",
    "test_episodic.py", "common/test_running_norms.py", "test_features.py", "test_problem.py",
    "test_nuisance.py", "test_callbacks.py", "test_sb3_surface.py", "test_vec_env.py", "information",
    "robustness/test_families.py", "evaluation/test_information_report.py", "evaluation/test_interval.py",
    "evaluation/test_interval_bounds.py", "certificates", "envs",
]  # fmt: skip
SETTINGS = """
[mutmut]
source_paths = sb3_tdpg
only_mutate =
    {code}
do_not_mutate_patterns =
    \\braise \\w+\\(
    \\bwarnings\\.warn\\(
    \\bassert\\b
    \\b(axes|figure)\\.
pytest_add_cli_args_test_selection =
    {tests}
pytest_add_cli_args =
    -m
    not slow
use_git_change_detection = false
"""


def stage() -> None:
    """Copy the files as in a wheel, with ``envs`` in the package, because mutmut derives module names from paths."""
    TREE.mkdir(parents=True, exist_ok=True)
    ignore = shutil.ignore_patterns("__pycache__")
    inside = {name: f"sb3_tdpg/{name}" for name in ("envs", "hyperparams")}
    for source, target in {"sb3_tdpg": "sb3_tdpg", **inside, "tests": "tests"}.items():
        shutil.copytree(ROOT / source, TREE / target, ignore=ignore, dirs_exist_ok=True)
    code = "\n    ".join(f"sb3_tdpg/{path}" for path in CODE)
    missing = [path for path in TESTS if not (ROOT / "tests" / path).exists()]
    missing += [path for path in CODE if not list(ROOT.glob(path)) + list((ROOT / "sb3_tdpg").glob(path))]
    if missing:
        raise FileNotFoundError(f"{missing} are not there: mend CODE and TESTS in {__file__}")
    tests = "\n    ".join(f"tests/{path}" for path in TESTS)
    (TREE / "setup.cfg").write_text((ROOT / "setup.cfg").read_text() + SETTINGS.format(code=code, tests=tests))


def mutmut(*arguments: str, check: bool = True) -> str:
    """Run mutmut in the copied tree and return its output; without ``check``, ignore its errors."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": ""}
    command, stderr = [sys.executable, "-m", "mutmut", *arguments], None if check else subprocess.DEVNULL
    done = subprocess.run(command, cwd=TREE, env=environment, stdout=subprocess.PIPE, text=True, stderr=stderr)
    if check and done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)[:200]} failed:\n{done.stdout[-3000:]}")
    return done.stdout


def results() -> dict[str, str]:
    """Return the state of each mutant, such as killed, survived, timeout, no tests or not checked."""
    return dict(re.findall(r"^\s*(\S+): (.+)$", mutmut("results", "--all", "true"), re.MULTILINE))


def main() -> int:
    """Print the undetected changes and the share of detected changes; return 1 if the goal is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="try all changes")
    parser.add_argument("--sample", type=int, default=400, help="number of changes to try")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--only", default="", help="only mutants whose name contains this text")
    given = parser.parse_args()
    stage()
    # No mutant has this name, so this call only makes the mutants and determines which tests reach them.
    mutmut("run", "--max-children", "1", "nothing.*", check=False)
    names = sorted(name for name in results() if given.only in name and not LEFT_OUT.search(name))
    chosen = names if given.all else random.Random(given.seed).sample(names, min(given.sample, len(names)))
    mutmut("run", "--max-children", str(usable_cores()), *chosen)
    states = {name: state for name, state in results().items() if name in set(chosen)}
    survivors = sorted(name for name, state in states.items() if state in ("survived", "no tests"))
    for name in survivors:
        print(mutmut("show", name))
    n_killed = len(states) - len(survivors)
    low, high = binomtest(n_killed, len(states)).proportion_ci(method="wilson")
    print(dict(Counter(states.values())))
    share = f"{n_killed / len(states):.1%} ({low:.1%} to {high:.1%} of all {len(names)}, with 95 % confidence)"
    print(f"{n_killed} of {len(states)} changes are noticed: {share}; goal {GOAL:.0%}")
    return int(n_killed / len(states) < GOAL)


if __name__ == "__main__":
    sys.exit(main())
