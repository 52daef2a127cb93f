"""Run every Python block of the pages, and the commands of the README and the tutorials.

Every print of a page has its output: `docs/_ext/page_examples.py` describes how a page shows it.
"""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import sys
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


sys.path.append(str(FOLDER / "docs" / "_ext"))
from page_examples import run, sections, store  # noqa: E402

CASES = [
    pytest.param(blocks, id=f"{page.relative_to(FOLDER)}: {title}")
    for page in PAGES
    for title, blocks in sections(page.read_text(encoding="utf-8"), whole=page.parent.name == "tutorials")
]


OPTIONAL = "no dependency, not even of the tests: .ci/optional installs it"


def unlike(blocks):
    """Run a section, and return the prints that the page does not show as they are."""
    lines = [block.text.split("\n") for block in blocks]
    stated = {
        (number, row): found[1]
        for number, block in enumerate(lines)
        for row, line in enumerate(block)
        if (found := re.search(r"# prints (.*)$", line))
    }
    printed, rest = {}, [""] * len(blocks)

    def record(number, row, text):
        if (number, row) not in stated:
            rest[number] += f"{text}\n"
        elif text != stated[number, row]:
            wrong.append((text, stated[number, row]))
        printed[number, row] = text

    wrong = []
    run(blocks, record)
    wrong += [("", text) for place, text in stated.items() if place not in printed]
    for number, text in enumerate(rest):
        after = blocks[number + 1 : number + 2]
        shown = after[0].text if after and after[0].kind == "output" else ""
        if not re.fullmatch(re.escape(shown).replace("…", ".*"), text, re.DOTALL):
            wrong.append((text, shown))
    return wrong


@pytest.mark.long
@pytest.mark.parametrize("blocks", CASES)
def test_blocks_run_and_print_and_draw_what_the_page_shows(blocks, tmp_path, monkeypatch):
    code = "\n".join(block.text for block in blocks)
    for name in ("SimpleITK", "nibabel", "nilearn", "skfem", "skimage", "datasets", "ray"):
        if re.search(rf"^(import|from) {name}\b", code, re.MULTILINE):
            pytest.importorskip(name, reason=OPTIONAL)
    if "import ray" in code:
        warnings.simplefilter("ignore")  # Ray uses its own deprecated options
    monkeypatch.chdir(tmp_path)
    assert unlike(blocks) == []
    for block in blocks:
        if block.kind == "{picture}":
            name, alt = block.words.split(maxsplit=1)
            assert alt
            published = tmp_path / "published"
            published.mkdir(exist_ok=True)
            assert 2_000 < store(Path(name), published).stat().st_size < 80_000, name


@pytest.mark.parametrize(
    "text",
    [
        "```python\nprint(1)  # prints 2\n```\n",
        "```python\nprint(1)\n```\n",
        "```python\nprint(1)\n```\n\n```output\n2\n```\n",
        "```python\nif 0:\n    print(1)  # prints 1\n```\n",
    ],
)
def test_a_wrong_output_is_found(text):
    ((_, blocks),) = sections(text, whole=True)
    assert unlike(blocks)


def test_outputs_may_be_abridged():
    ((_, blocks),) = sections(
        "```python\nfor i in range(9):\n    print(i)\n```\n\n```output\n0\n…\n8\n```\n", whole=True
    )
    assert unlike(blocks) == []


DOCS = FOLDER / "docs"
GUIDES = sorted([*DOCS.glob("howto/*.md"), *DOCS.glob("tutorials/*.md")])


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_guides_are_short(page):
    lines = page.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 250
    assert [line for line in lines if len(line) > 100 and not line.startswith("|")] == []


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_guides_say_how_to_install_what_they_import(page):
    text = page.read_text(encoding="utf-8")
    imported = {first or second for first, second in re.findall(r"^(?:import (\w+)|from (\w+)\S* import )", text, re.M)}
    installed = {"quasiharmonic", "numpy", "scipy", "matplotlib", *sys.stdlib_module_names}
    names = {"skfem": "scikit-fem", "skimage": "scikit-image", "nibabel": r"\.\[neuro\]"}
    commands = re.findall(r"pip\s+install ([^`\n]*)", text)
    for name in imported - installed:
        assert any(re.search(rf"(?<!\w){names.get(name, name)}(?!\w)", packages) for packages in commands), name


def test_pictures_import_only_what_the_package_requires():
    for case in CASES:
        (blocks,) = case.values
        if any(block.kind == "{picture}" for block in blocks):
            code = "\n".join(block.text for block in blocks if block.kind != "output")
            imported = set(re.findall(r"^(?:from|import) (\w+)", code, re.MULTILINE))
            assert imported <= {"quasiharmonic", "numpy", "matplotlib"} | sys.stdlib_module_names, case.id


def test_most_guides_have_a_picture():
    with_picture = {
        page for page in GUIDES if re.search(r"^(```\{picture\}|!\[)", page.read_text("utf-8"), re.MULTILINE)
    }
    assert {page for page in GUIDES if page.parent.name == "tutorials" and page.stem != "index"} <= with_picture
    assert len(with_picture) >= 15


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
