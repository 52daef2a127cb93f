"""The house keeps its plan: the table of rooms in docs/architecture.md is what the imports are."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import quasiharmonic

ROOT = Path(quasiharmonic.__file__).parent
PAGE = (Path(__file__).parent.parent / "docs" / "architecture.md").read_text(encoding="utf-8")
PLAN = {
    name: {other.strip() for other in others.split(",") if other.strip()}
    for name, others in re.findall(r"^\| `([\w/]+)` \|.*\| ([\w/, ]*)\|$", PAGE, re.MULTILINE)
}
# The public names are gathered from everywhere; the command is started from one place.
FACE = {"__init__", "__main__"}


def room(parts):
    """The room of a module, given the parts of its dotted name after the package's."""
    nested = "/".join(parts[:2])
    return nested if nested in PLAN else parts[0]


def named(tree):
    """The package's own modules that a file imports from, as parts of their dotted names after the package's.

    Public names of the package itself are an error, since each stands for a module that `quasiharmonic` imports late.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            dotted = [(alias.name.split("."), None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "a relative import"
            dotted = [((node.module or "").split("."), alias.name) for alias in node.names]
        else:
            continue
        for (package, *of), name in dotted:
            if package != "quasiharmonic":
                continue
            # What is imported may itself be a module or a folder.
            deeper = ROOT.joinpath(*of, name or "")
            whole = (*of, name) if name and (deeper.is_dir() or deeper.with_suffix(".py").exists()) else tuple(of)
            assert whole or name == "__version__", f"{name or 'all'} from the package's face: import from its module"
            if whole:
                yield whole


@cache
def imports():
    """(room, other room, file) for every import of the package's own modules, wherever in a file it stands."""
    found = []
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        for whole in named(ast.parse(path.read_text(encoding="utf-8"), path)):
            if room(whole) != room(parts):
                found.append((room(parts), room(whole), str(path.relative_to(ROOT))))
    return found


def arrows():
    """(room, other room) for every pair of which one imports from the other."""
    return {(one, other) for one, other, _ in imports() if one not in FACE}


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
    assert {(one, other) for one, others in PLAN.items() for other in others} - arrows() == set()


def test_no_circle_and_nothing_upwards():
    """The rooms stand in an order in which each imports only from those before it."""
    order = list(PLAN)
    assert [(one, other) for one, other in arrows() if order.index(other) >= order.index(one)] == []


def test_every_kind_of_import_is_seen():
    code = "import numpy, quasiharmonic.io.off as o\ndef f():\n    from quasiharmonic.plot import maps, texture_map"
    assert list(named(ast.parse(code))) == [("io", "off"), ("plot", "maps"), ("plot",)]
    assert list(named(ast.parse("from quasiharmonic import __version__, mesh"))) == [("mesh",)]


@pytest.mark.parametrize("code", ["from quasiharmonic import solve", "import quasiharmonic", "from . import io"])
def test_what_says_no_room_is_refused(code):
    with pytest.raises(AssertionError):
        list(named(ast.parse(code)))
