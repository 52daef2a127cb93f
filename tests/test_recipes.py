"""The recipes in `docs/development/extending.md` run as shown, and the files that they name exist."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from quasiharmonic import io
from quasiharmonic.io import registry
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
    mesh = io.MeshData([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]], statements=b"g a\n")
    assert io.not_held("mesh.npm", mesh) == ["groups"]


@pytest.mark.parametrize("page", PAGES)
def test_every_named_path_exists(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:src|tests|docs|benchmarks|examples|[a-z]+/)[\w./]*\.\w+|[a-z]+/[\w./]+\.py)`", text))
    missing = [name for name in named if not any((base / name).exists() for base in (ROOT, ROOT / "src/quasiharmonic"))]
    assert named
    assert missing == []
