"""Modules import only from their own layer or lower layers, without cycles between files or folders."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "sb3_tdpg"

# The layers from bottom to top. A module imports from its own layer and from lower layers. Files that are not listed
# belong to the layer "algorithm".
LAYERS = [
    ["common"],
    ["information"],
    ["algorithm"],
    ["evaluation", "robustness"],
    ["deployment", "distributed"],
    ["certificates", "experiments", "hub", "report", "zoo"],
    ["paper"],
    ["cli", "__init__", "__main__"],
]
LEVELS = {name: level for level, names in enumerate(LAYERS) for name in names}
# The algorithm imports these modules only when a model needs them.
ON_DEMAND = {("episodic", "deployment.export"), ("episodic", "robustness.nuisance")}


def module_of(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_of(path): path for path in PACKAGE.rglob("*.py")}


def imports(path):
    """Yield the modules of this package that a file imports, except imports only for type checkers."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_types = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node not in for_types and (node.module or "").startswith("sb3_tdpg."):
            module = node.module.removeprefix("sb3_tdpg.")
            for name in node.names:
                found = f"{module}.{name.name}" if f"{module}.{name.name}" in MODULES else module
                if found in MODULES:
                    yield found


GRAPH = {
    name: sorted({other for other in imports(path) if (name, other) not in ON_DEMAND}) for name, path in MODULES.items()
}


def layer_of(module):
    first = module.split(".")[0]
    return first if first in LEVELS else "algorithm"


def test_every_folder_has_a_layer():
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert folders == {name for names in LAYERS for name in names if (PACKAGE / name).is_dir()}


@pytest.mark.parametrize("module", [name for name in sorted(GRAPH) if name not in ("__init__", "__main__", "cli")])
def test_imports_run_down(module):
    up = [other for other in GRAPH[module] if LEVELS[layer_of(other)] > LEVELS[layer_of(module)]]
    assert not up, f"{module} is below {up}"


def test_folders_make_no_circle():
    folders = {}
    for module, others in GRAPH.items():
        targets = {layer_of(other) for other in others}
        folders.setdefault(layer_of(module), set()).update(targets - {layer_of(module)})
    list(TopologicalSorter(folders).static_order())  # raises a CycleError, which names the cycle


def test_files_make_no_circle():
    list(TopologicalSorter(GRAPH).static_order())


def test_the_algorithm_imports_few_files():
    seen, left = set(), ["tdpg"]
    while left:
        module = left.pop()
        if module not in seen:
            seen.add(module)
            left += GRAPH[module]
    assert len(seen) <= 20, sorted(seen)
