"""The version is written in `quasiharmonic.__init__`; every other place takes it from there or agrees."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from quasiharmonic import __version__

ROOT = Path(__file__).parent.parent


def test_it_is_defined_once():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert "version" in settings["project"]["dynamic"]
    assert settings["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "quasiharmonic.__version__"}
    source = (ROOT / "src" / "quasiharmonic" / "__init__.py").read_text(encoding="utf-8")
    # As a literal, so that a build reads it without running code.
    assert re.findall(r'^__version__ = "(\d+\.\d+\.\d+\w*)"$', source, re.MULTILINE) == [__version__]


def test_the_citation_contains_it():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [__version__]


def test_the_documentation_takes_it_from_the_package():
    configuration = (ROOT / "docs" / "conf.py").read_text(encoding="utf-8")
    assert "from quasiharmonic import __version__" in configuration
    assert __version__ not in configuration
