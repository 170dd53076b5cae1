"""
Check the types of the package: ``make type``.

``envs/`` and ``hyperparams/`` are folders beside ``sb3_tdpg/``, but their modules belong to this package. mypy's
command line derives a module's name only from its folder, so this script sets the names of their modules.
"""

import sys
from pathlib import Path

from mypy.build import build
from mypy.errors import CompileError
from mypy.main import process_options
from mypy.modulefinder import BuildSource

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run mypy and return the exit code."""
    files = [path for name in ("sb3_tdpg", "envs", "hyperparams") for path in sorted((ROOT / name).rglob("*.py"))]
    _, options = process_options(["--config-file", str(ROOT / "setup.cfg"), "--fast-module-lookup", "-m", "sb3_tdpg"])
    sources = []
    for path in files:
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = parts if parts[0] == "sb3_tdpg" else ("sb3_tdpg", *parts)
        sources.append(BuildSource(str(path), ".".join(parts).removesuffix(".__init__")))
    try:
        errors = build(sources, options).errors
    except CompileError as e:
        errors = e.messages
    print("\n".join(errors) or f"no type errors in {len(sources)} files")
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
