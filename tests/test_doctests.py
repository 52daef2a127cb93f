"""Run the examples of the docstrings."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from pathlib import Path

import pytest

import quasiharmonic

ROOT = Path(quasiharmonic.__file__).parent
NAMES = sorted(
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
    for path in ROOT.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_examples_print_the_shown_output(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testmod(importlib.import_module(name))
    assert tried
    assert not failed


PAGE = Path(__file__).parent.parent / "docs" / "reference" / "python.md"


def find_name(name):
    """Return what a name of the package denotes: a module, or an attribute of one."""
    try:
        return importlib.import_module(f"quasiharmonic.{name}")
    except ModuleNotFoundError:
        module, _, attribute = f"quasiharmonic.{name}".rpartition(".")
        return getattr(importlib.import_module(module), attribute)


PUBLIC = [
    name
    for name in re.findall(r"^   ([\w.]+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    if not inspect.ismodule(find_name(name))
]


def test_the_page_has_public_names():
    assert len(PUBLIC) > 90


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name_has_an_example_that_is_run(name):
    public = find_name(name)
    assert public.__module__ in NAMES
    found = doctest.DocTestFinder().find(importlib.import_module(public.__module__))
    (examples,) = (test.examples for test in found if test.name == f"{public.__module__}.{public.__name__}")
    # An import is no example.
    assert [one for one in examples if not one.source.startswith(("import ", "from "))]


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name_names_others_that_exist(name):
    text = inspect.getdoc(find_name(name))
    assert text.count("See Also\n--------\n") == 1
    listed = text.split("See Also\n--------\n")[1].split("\n\n")[0].splitlines()
    assert listed
    for line in listed:
        # Sphinx shows no description after several names.
        other = re.fullmatch(r"([\w.]+) : [A-Z].+\.", line)[1].removeprefix("quasiharmonic.")
        assert find_name(other).__doc__
        assert find_name(other) is not find_name(name)
