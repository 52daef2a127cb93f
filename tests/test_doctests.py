"""Run the examples of the docstrings."""

from __future__ import annotations

import doctest
import importlib
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
