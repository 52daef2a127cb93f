"""Run every Python block of the pages, and the commands of the README and the tutorials.

The blocks of a section, and all blocks of a tutorial, share their names.

A comment `# prints …` after a `print` states its output, and the test compares it.
"""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import warnings
from contextlib import chdir
from importlib import import_module
from inspect import ismodule
from pathlib import Path

import pytest

import quasiharmonic
from quasiharmonic.ui.cli import main

FOLDER = Path(__file__).parent.parent
# `test_recipes.py` runs the recipes of `extending.md`, in modules.
PAGES = (FOLDER / "README.md", *sorted({*(FOLDER / "docs").rglob("*.md")} - {FOLDER / "docs/development/extending.md"}))


def sections(page):
    """Return title and code of each section with code; a tutorial is one section."""
    found = [(page.name, [])]
    # A line that begins with # is a comment in a block, and a heading outside.
    for heading, language, code in re.findall(
        r"^#+ ([^\n]*)$|^```([^\n]*)\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    ):
        if heading and page.parent.name != "tutorials":
            found.append((heading, []))
        elif language == "python":
            found[-1][1].append(code)
    return [(title, "\n".join(blocks)) for title, blocks in found if blocks]


CASES = [
    pytest.param(code, id=f"{page.relative_to(FOLDER)}: {title}") for page in PAGES for title, code in sections(page)
]


OPTIONAL = "no dependency, not even of the tests: .ci/optional installs it"


@pytest.mark.long
@pytest.mark.parametrize("code", CASES)
def test_block_runs(code, tmp_path, monkeypatch, capsys):
    for name in ("SimpleITK", "nibabel", "nilearn", "skfem", "skimage", "datasets", "ray"):
        if re.search(rf"^(import|from) {name}\b", code, re.MULTILINE):
            pytest.importorskip(name, reason=OPTIONAL)
    if "import ray" in code:
        warnings.simplefilter("ignore")  # Ray uses its own deprecated options
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "block", "exec"), {"__name__": "block"})
    printed = capsys.readouterr().out.splitlines()
    assert [
        line for line in re.findall(r"^ *print\(.*\)  # prints (.*)$", code, re.MULTILINE) if line not in printed
    ] == []


DOCS = FOLDER / "docs"


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The folder that `qhm demo`, the first command of every page, writes."""
    folder = tmp_path_factory.mktemp("demo")
    with chdir(folder):
        assert main(["demo"]) == 0
    return folder


@pytest.mark.long
@pytest.mark.parametrize("page", ["README.md", "docs/tutorials/first_shape.md", "docs/tutorials/textured_model.md"])
def test_commands_run(page, demo, tmp_path, monkeypatch):
    lines = re.findall(r"^    (qhm .*)$", (FOLDER / page).read_text(encoding="utf-8"), re.MULTILINE)
    first, *commands = (shlex.split(line, comments=True)[1:] for line in lines)
    assert first == ["demo"]
    assert commands
    shutil.copytree(demo, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    for command in commands:
        assert main(command) == 0, command


def test_the_speed_table_of_the_readme_has_the_measured_times():
    with (FOLDER / "docs" / "speed" / "speed.csv").open(encoding="utf-8") as file:
        seconds = {(row["problem"], int(row["triangles"]), row["tool"]): row["seconds"] for row in csv.DictReader(file)}
    table = re.findall(
        r"^\| ([\d,]+) triangles \| ([\d.]+) s \| ([\d.]+) s \|$", PAGES[0].read_text("utf-8"), re.MULTILINE
    )
    assert len(table) == 3
    for triangles, *times in table:
        for tool, time in zip(("quasiharmonic", "igl.harmonic"), times, strict=True):
            measured = float(seconds["cat on R", int(triangles.replace(",", "")), tool])
            assert time == f"{measured:.{len(time.partition('.')[2])}f}"


REFERENCE = re.findall(r"^   ([\w.]+)$", (DOCS / "reference/python.md").read_text(encoding="utf-8"), re.MULTILINE)


def found(name):
    """Return what a name of the reference denotes: a module, or an attribute of one."""
    try:
        return import_module(f"quasiharmonic.{name}")
    except ModuleNotFoundError:
        module, _, attribute = f"quasiharmonic.{name}".rpartition(".")
        return getattr(import_module(module), attribute)


@pytest.mark.parametrize("name", REFERENCE)
def test_names_of_the_reference_exist(name):
    assert found(name).__doc__


def test_the_reference_has_every_public_name():
    names = {name for name in quasiharmonic.__all__ if not ismodule(getattr(quasiharmonic, name))}
    assert names <= set(REFERENCE)


def test_tests_named_on_the_page_about_the_paper_exist():
    named = set(re.findall(r"`(test_\w+|Test\w+)`", (DOCS / "development/paper.md").read_text(encoding="utf-8")))
    text = "\n".join(path.read_text(encoding="utf-8") for path in (FOLDER / "tests").glob("test_*.py"))
    there = set(re.findall(r"^ *(?:def|class) (\w+)", text, re.MULTILINE))
    assert len(named) > 10
    assert named <= there
