"""The house keeps its plan: the table of rooms in docs/architecture.md is what the imports are."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import quasiharmonic

ROOT = Path(quasiharmonic.__file__).parent
PAGE = (Path(__file__).parent.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
PLAN = {
    name: {other for other in re.split(r",\s*", others) if other}
    for name, others in re.findall(r"^\| `([\w/]+)` \|.*\| ([\w/, ]*)\|$", PAGE.replace(" |", " |"), re.MULTILINE)
}
PLAN = {name: {other.strip() for other in others if other.strip()} for name, others in PLAN.items()}
# The public names are gathered from everywhere; the command is started from one place.
FACE = {"__init__", "__main__"}


def room(parts):
    """The room of a module, given the parts of its dotted name after the package's."""
    nested = "/".join(parts[:2])
    return nested if nested in PLAN else parts[0]


def imports():
    """(room, other room, file) for every import of the package's own modules, wherever in a file it stands."""
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            assert not (isinstance(node, ast.ImportFrom) and node.level), f"{path}: a relative import"
            if not isinstance(node, ast.ImportFrom) or (node.module or "").split(".")[0] != "quasiharmonic":
                continue
            of = tuple(node.module.split(".")[1:])
            for alias in node.names:
                # What is imported may itself be a module or a folder.
                deeper = ROOT.joinpath(*of, alias.name)
                whole = (*of, alias.name) if deeper.is_dir() or deeper.with_suffix(".py").exists() else of
                if whole and room(whole) != room(parts):
                    yield room(parts), room(whole), str(path.relative_to(ROOT))


ARROWS = {(one, other) for one, other, _ in imports() if one not in FACE}


def test_every_room_is_in_the_plan():
    modules = {path.stem for path in ROOT.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert modules - FACE <= set(PLAN)
    assert {name.split("/")[0] for name in PLAN} <= modules
    assert len([path for path in ROOT.iterdir() if path.suffix == ".py"]) <= 6


def test_no_arrow_but_those_of_the_plan():
    unplanned = [f"{file} imports from {other}" for one, other, file in imports() if one not in FACE | {other}
                 and other not in PLAN[one]]  # fmt: skip
    assert unplanned == []


def test_no_arrow_of_the_plan_is_idle():
    assert {(one, other) for one, others in PLAN.items() for other in others} - ARROWS == set()


def test_no_circle_and_nothing_upwards():
    """The rooms stand in an order in which each imports only from those before it."""
    order = list(PLAN)
    assert [(one, other) for one, other in ARROWS if order.index(other) >= order.index(one)] == []
