"""The recipes in CONTRIBUTING.md run as they stand, and what they name is there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from shared.formats import try_format, with_map

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
# Every block of a section is part of its recipe.
RECIPES = {
    title: "\n".join(blocks)
    for title, *text in (section.split("\n", 1) for section in re.split(r"^##+ ", TEXT, flags=re.MULTILINE))
    if (blocks := re.findall(r"^```python\n(.*?)^```", *text, re.MULTILINE | re.DOTALL))
}
PAGES = "CONTRIBUTING.md", "docs/architecture.md"


def test_there_is_one_for_each():
    assert set(RECIPES) == {
        "A functional",
        "An energy",
        "A linear solver",
        "A kernel",
        "A way to descend",
        "A file format",
        "An outline",
        "A subcommand",
    }


@pytest.mark.parametrize("name", RECIPES)
def test_recipe_runs(name, tmp_path):
    assert "assert" in RECIPES[name]
    done = subprocess.run([sys.executable, "-c", RECIPES[name]], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_format_stands_its_trials(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(RECIPES["A file format"], names)
    try_format(names["read_npz"], with_map(names["write_npz"]), tmp_path / "mesh.npz")


@pytest.mark.parametrize("page", PAGES)
def test_every_path_named_is_there(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:src|tests|docs|benchmarks|examples|[a-z]+/)[\w./]*\.\w+|[a-z]+/[\w./]+\.py)`", text))
    missing = [name for name in named if not any((base / name).exists() for base in (ROOT, ROOT / "src/quasiharmonic"))]
    assert named
    assert missing == []
