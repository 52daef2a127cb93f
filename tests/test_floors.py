"""Nothing imports upwards: the table of floors in CONTRIBUTING.md holds, and has every module."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import quasiharmonic

ROOT = Path(quasiharmonic.__file__).parent
TABLE = (Path(__file__).parent.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
FLOORS = {
    name: int(floor)
    for floor, row in re.findall(r"^\| (\d) \| (.*) \|$", TABLE, re.MULTILINE)
    for name in re.findall(r"`(\w+)`", row)
}


def imported(path):
    """First parts of the package's modules that a file imports, wherever in it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "quasiharmonic":
            parts = node.module.split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]


def test_every_module_has_a_floor():
    modules = {path.name.removesuffix(".py") for path in ROOT.iterdir() if path.suffix == ".py" or path.is_dir()}
    assert modules - {"__init__", "__main__", "__pycache__"} == set(FLOORS)


def test_nothing_imports_upwards():
    upwards = [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in ROOT.rglob("*.py")
        if (floor := FLOORS.get(path.relative_to(ROOT).parts[0].removesuffix(".py")))
        for module in imported(path)
        if FLOORS.get(module, 0) > floor
    ]
    assert upwards == []
