"""Every Python block of the pages runs; those of one section, and all of the tutorial, share their names."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import quasiharmonic

FOLDER = Path(__file__).parent.parent
PAGES = (
    FOLDER / "README.md",
    FOLDER / "docs" / "index.md",
    FOLDER / "docs" / "existence.md",
    FOLDER / "docs" / "files.md",
    FOLDER / "docs" / "flatten.md",
    FOLDER / "docs" / "gradients.md",
    FOLDER / "docs" / "howto.md",
    FOLDER / "docs" / "method.md",
    FOLDER / "docs" / "notebook.md",
    FOLDER / "docs" / "registration.md",
    FOLDER / "docs" / "tutorial.md",
)


def sections(page):
    """Title and code of each section that has code; the tutorial is one."""
    text = page.read_text(encoding="utf-8")
    for section in [text] if page.stem == "tutorial" else re.split(r"^#+ ", text, flags=re.MULTILINE):
        blocks = re.findall(r"^```python\n(.*?)^```", section, flags=re.MULTILINE | re.DOTALL)
        if blocks:
            yield section.splitlines()[0], "\n".join(blocks)


CASES = [
    pytest.param(code, id=f"{page.stem}: {title}") for page in PAGES if page.exists() for title, code in sections(page)
]


@pytest.mark.slow
@pytest.mark.parametrize("code", CASES)
def test_block_runs(code, tmp_path, monkeypatch):
    if "import SimpleITK" in code:
        pytest.importorskip("SimpleITK", reason="no dependency, not even of the tests: .ci/optional installs it")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "block", "exec"), {"__name__": "block"})


REFERENCE = re.findall(r"^   ([\w.]+)$", (FOLDER / "docs" / "reference.md").read_text(encoding="utf-8"), re.MULTILINE)


def found(name):
    """What a name of the reference stands for: a module, or an attribute of one."""
    try:
        return import_module(f"quasiharmonic.{name}")
    except ModuleNotFoundError:
        module, _, attribute = f"quasiharmonic.{name}".rpartition(".")
        return getattr(import_module(module), attribute)


@pytest.mark.parametrize("name", REFERENCE)
def test_what_the_reference_names_is_there(name):
    assert found(name).__doc__


def test_the_reference_has_every_public_name():
    assert set(quasiharmonic.__all__) <= set(REFERENCE)


def test_tests_that_the_page_on_the_paper_names_are_there():
    named = set(re.findall(r"`(test_\w+|Test\w+)`", (FOLDER / "docs" / "paper.md").read_text(encoding="utf-8")))
    text = "\n".join(path.read_text(encoding="utf-8") for path in (FOLDER / "tests").glob("test_*.py"))
    there = set(re.findall(r"^ *(?:def|class) (\w+)", text, re.MULTILINE))
    assert len(named) > 10
    assert named <= there
