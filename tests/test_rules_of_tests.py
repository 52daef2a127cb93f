"""Tests share the code in `shared`: they import no other test and no private names, and use no file outside.

No file is too long to read at once.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent
MODULES = sorted(FOLDER.rglob("*.py"))
TESTS = {path.stem for path in FOLDER.rglob("test_*.py")}
MAX_LINES = 450
# What `read` returns.
READ = {ast.Import, ast.ImportFrom, ast.Attribute, ast.Call}
# Methods of `namedtuple` have an underscore to be no fields, and notebooks' methods by convention: none is private.
PUBLIC = {"_replace", "_asdict", "_fields", "_make", "_repr_html_", "_repr_png_"}


def private(name):
    return name.startswith("_") and not name.startswith("__") and name not in PUBLIC


def read(text):
    """The imports, attributes and calls of a file."""
    return [node for node in ast.walk(ast.parse(text)) if type(node) in READ]


def imports(nodes):
    """Yield (module, name or None) of every import."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "tests are no package"
            yield from ((node.module, alias.name) for alias in node.names)


def called(node):
    """The name of the function or method that a call calls."""
    return getattr(node.func, "attr", getattr(node.func, "id", ""))


def private_names(nodes):
    """Yield names with an underscore that are imported, accessed, or replaced by `monkeypatch.setattr`."""
    for module, name in imports(nodes):
        yield from (part for part in (*module.split("."), name or "") if private(part))
    for node in nodes:
        # A class of the tests that implements a protocol may call the method that it replaces.
        if (
            isinstance(node, ast.Attribute)
            and private(node.attr)
            and ast.unparse(node.value) not in ("self", "super()")
        ):
            yield node.attr
        if isinstance(node, ast.Call) and called(node) in ("setattr", "getattr", "delattr"):
            words = [a.value for a in node.args[:2] if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            yield from (part for word in words for part in word.split(".") if private(part))


def optional_packages(nodes):
    """Yield the packages without which a test is skipped."""
    for node in nodes:
        if isinstance(node, ast.Call) and called(node) == "importorskip" and isinstance(node.args[0], ast.Constant):
            yield node.args[0].value


@cache
def facts(path):
    """Modules that a file imports, private names, and optional packages; to keep the trees would take longer."""
    nodes = read(path.read_text(encoding="utf-8"))
    return [module for module, _ in imports(nodes)], list(private_names(nodes)), list(optional_packages(nodes))


def test_no_file_is_long():
    lines = {path.name: path.read_text(encoding="utf-8").count("\n") for path in MODULES}
    assert not {name: count for name, count in lines.items() if count > MAX_LINES}, "split it by behaviour"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(FOLDER).as_posix())
def test_rules(path):
    text, (modules, private, _) = path.read_text(encoding="utf-8"), facts(path)
    assert not [module for module in modules if module.split(".")[-1] in TESTS | {"conftest"}]
    assert not private
    assert not re.search(r"parents\[[2-9]\]|\.parent\.parent\.parent", text), "looks outside the checkout"


@pytest.mark.parametrize(
    "code",
    [
        "from quasiharmonic.solver.mapping import _hidden",
        "import quasiharmonic._hidden",
        "result._hidden()",
        "monkeypatch.setattr('quasiharmonic.solver.search.search._hidden', 1)",
        "patch.setattr(solving, '_hidden', 1)",
    ],
)
def test_private_names_are_detected(code):
    assert list(private_names(read(code))) == ["_hidden"]


def test_imports_of_tests_are_detected():
    assert list(imports(read("def f():\n    from test_cli import run"))) == [("test_cli", "run")]


def test_files_named_in_scripts_exist():
    scripts = [path for path in (ROOT / ".ci").iterdir() if path.is_file()] + [ROOT / "pyproject.toml"]
    named = {name for path in scripts for name in re.findall(r"tests/[\w/]+\.py", path.read_text(encoding="utf-8"))}
    assert len(named) > 10
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


@pytest.mark.slow
def test_packages_that_tests_skip_without_are_installed_somewhere():
    """Every package is required, is part of an extra that `.ci/test` installs, or is installed by `.ci/optional`."""
    wanted = {package for path in MODULES for package in facts(path)[2]}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    brought = re.search(r"\[(.*)\]", extras["test"][0]).group(1).split(",")
    installed = " ".join(project["dependencies"] + [line for name in ("test", *brought) for line in extras[name]])
    optional = (ROOT / ".ci" / "optional").read_text(encoding="utf-8")
    by_itself = re.search(r"install test,view,cortex,notebook (gmsh vtk.*)", optional).group(1).split()
    assert "scikit-sparse" in optional
    assert {"shapely", "polyscope", "torch", "jax"} <= wanted
    gradients = (ROOT / ".ci" / "gradients").read_text(encoding="utf-8")
    layers = re.findall(r'pip install --quiet --no-compile "?(\w+)', gradients)
    assert layers == ["torch", "jax"]
    assert "install test scikit-fem" in gradients
    browser = (ROOT / ".ci" / "browser").read_text(encoding="utf-8")
    pages = re.findall(r"[a-z]+", re.search(r"install test,notebook (.*)", browser).group(1))
    extra = [
        *extras["view"],
        *extras["cortex"],
        *extras["notebook"],
        *extras["remote"],
        *by_itself,
        *layers,
        *pages,
        "skfem",
    ]
    known = f"{installed} quasiharmonic {' '.join(extra)}"
    assert not [name for name in wanted if name not in sys.stdlib_module_names and name.split(".")[0] not in known]
