"""The recipes in `docs/development/extending.md` run as shown, and the files that they name exist."""

from __future__ import annotations

import ast
import re
import sys
import threading
from pathlib import Path
from types import ModuleType

import pytest

from quasiharmonic import injective_map, io
from quasiharmonic.io import MeshData, registry
from quasiharmonic.surfaces import cat, starfish
from quasiharmonic.targets import boundary_to
from quasiharmonic.ui.cli import main
from shared.formats import try_format

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "development" / "extending.md").read_text(encoding="utf-8")
# Every block of a section belongs to its recipe.
RECIPES = {
    title: "\n".join(blocks)
    for title, *text in (section.split("\n", 1) for section in re.split(r"^##+ ", TEXT, flags=re.MULTILINE))
    if (blocks := re.findall(r"^```python\n(.*?)^```", *text, re.MULTILINE | re.DOTALL))
}
PAGES = "CONTRIBUTING.md", "docs/development/extending.md", "docs/development/architecture.md"


def test_all_recipes_are_tested():
    assert set(RECIPES) == {
        "A functional",
        "An energy",
        "A linear solver",
        "A kernel",
        "A descent method",
        "A file format",
        "An outline",
        "A subcommand",
        "An option",
    }


@pytest.mark.parametrize("name", RECIPES)
def test_recipe_runs(name, tmp_path, monkeypatch):
    assert "assert" in RECIPES[name]
    monkeypatch.chdir(tmp_path)
    # Dataclasses look their module up. The code has no imports from this file, not even those from the future.
    module = ModuleType("recipe")
    monkeypatch.setitem(sys.modules, "recipe", module)
    exec(compile(RECIPES[name], name, "exec", dont_inherit=True), module.__dict__)


def test_the_format_passes_its_tests(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(RECIPES["A file format"], names)
    monkeypatch.setattr(registry, "FORMATS", (names["NPM"], *io.FORMATS))
    try_format(io.read_mesh, io.write_map, tmp_path / "mesh.npm")
    assert io.format_names("write_map").startswith("NPM, OBJ")
    mesh = MeshData([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]], statements=b"g a\n")
    assert io.not_held("mesh.npm", mesh) == ["groups"]


@pytest.mark.parametrize("page", PAGES)
def test_every_named_path_exists(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:src|tests|docs|benchmarks|examples|[a-z]+/)[\w./]*\.\w+|[a-z]+/[\w./]+\.py)`", text))
    missing = [name for name in named if not any((base / name).exists() for base in (ROOT, ROOT / "src/quasiharmonic"))]
    assert named
    assert missing == []


def map_the_cat(_):
    V, F = cat()
    injective_map(V, F, *boundary_to(V, F, "letter:R"), polish="mips", max_iterations=200)


def unwrap_a_starfish(folder):
    path = folder / "model.obj"
    V, F = starfish(5, 14)
    path.write_text(
        "".join([*map("v {} {} {}\n".format, *V.T.tolist()), *map("f {} {} {}\n".format, *(F + 1).T.tolist())])
    )
    assert main(["unwrap", str(path), "-o", str(folder / "out.obj")]) == 0


def calls_of(work):
    """The qualified names of all functions that are called, in order."""
    names = []

    def note(frame, event, _):
        if event == "call":
            names.append(frame.f_code.co_qualname)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return names


def is_call(call, name):
    """Whether a function of this qualified name is meant; `Descent.start` also names methods of its subclasses."""
    return call.endswith(name) if "." in name else call.rpartition(".")[2] == name


@pytest.mark.long
@pytest.mark.parametrize(
    ("title", "work"),
    [
        ("From `V`, `F` and `target` to a result", map_the_cat),
        ("From a file through `qhm unwrap`", unwrap_a_starfish),
    ],
)
def test_the_steps_of_the_architecture_run_in_their_order(title, work, tmp_path):
    """Functions in the steps exist; those that are called without special options run in the order of the page."""
    text = (ROOT / "docs/development/architecture.md").read_text(encoding="utf-8")
    steps = re.findall(r"^\d+\. (.*)$", text.split(f"## {title}\n")[1].split("\n## ")[0], re.MULTILINE)
    assert len(steps) == 10
    defined = {
        node.name
        for path in (ROOT / "src").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }
    named = [name for step in steps for name in re.findall(r"`([A-Za-z]\w+(?:\.\w+)?)`", step)]
    functions = [name for name in named if name.rpartition(".")[2][0].islower() and not name.endswith(".py")]
    assert [name for name in functions if name.rpartition(".")[2] not in defined] == []
    special = {"accepts_mesh", "takes", "search_refining", "diagnose", "mend_charts"}
    calls = iter(calls_of(lambda: work(tmp_path)))
    for name in functions:
        assert name in special or any(is_call(call, name) for call in calls), name
