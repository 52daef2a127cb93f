"""The imports between packages match the table in docs/development/architecture.md."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import quasiharmonic

ROOT = Path(quasiharmonic.__file__).parent
PAGE = (Path(__file__).parent.parent / "docs" / "development" / "architecture.md").read_text(encoding="utf-8")
PLAN = {
    name: {other.strip() for other in others.split(",") if other.strip()}
    for name, others in re.findall(r"^\| `(\w+)` \|.*\| ([\w, ]*)\|$", PAGE, re.MULTILINE)
}
# What `imported` reads: imports, strings, and what may have a docstring.
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
READ = {*DOCUMENTED, ast.Import, ast.ImportFrom, ast.Constant}
# These modules re-export names of packages: the public names, the command, and the short public paths.
FACADE = {"__init__", "__main__", "atlas", "batch", "jax", "plot", "results", "surfaces", "torch"}


@cache
def parse(path):
    """Return the syntax tree of a file; tests do not change it."""
    return ast.parse(path.read_text(encoding="utf-8"), path)


@cache
def is_module(parts):
    """Whether a module or package has this dotted name, given as parts after the library's name."""
    path = ROOT.joinpath(*parts)
    return all(parts) and bool(parts) and (path.with_suffix(".py").exists() or (path / "__init__.py").exists())


def imported(tree):
    """Modules of the library that a file imports, as parts of their dotted names, including imports by string.

    Public names of the library itself are an error, because `quasiharmonic` imports their modules lazily.
    """
    docstrings = set()
    # A node is visited after the one that contains it.
    for node in ast.walk(tree):
        if type(node) not in READ:
            continue
        if isinstance(node, DOCUMENTED) and isinstance(node.body[0], ast.Expr):
            docstrings.add(id(node.body[0].value))
        if isinstance(node, ast.Import):
            dotted = [(alias.name.split("."), None) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "a relative import"
            dotted = [((node.module or "").split("."), alias.name) for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            parts = node.value.split(".")
            dotted = [(parts, None)] if parts[0] == "quasiharmonic" and is_module(tuple(parts[1:])) else []
        else:
            continue
        for (package, *of), name in dotted:
            if package != "quasiharmonic":
                continue
            # The imported name may itself be a module or a package.
            whole = (*of, name) if name and is_module((*of, name)) else tuple(of)
            assert whole or name == "__version__", f"{name or 'all'} from the library itself: import from its module"
            if whole:
                yield whole


@cache
def imports_of_files():
    """A dictionary from every file, relative to the library's folder, to the list of modules that it imports."""
    return {
        path.relative_to(ROOT): list(imported(parse(path)))
        for path in sorted(ROOT.rglob("*.py"))
        if path.relative_to(ROOT).with_suffix("").parts[0] not in FACADE
    }


def imports():
    """(package, other package, file) for every import across packages, at any position in a file."""
    for file, modules in imports_of_files().items():
        for whole in modules:
            if whole[0] != file.parts[0]:
                yield file.parts[0], whole[0], str(file)


def arrows():
    return {(one, other) for one, other, _ in imports()}


def test_the_plan_names_every_package():
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages == set(PLAN)
    assert len(packages) <= 10


def test_no_other_modules_are_next_to_the_packages():
    modules = {path.stem for path in ROOT.glob("*.py")}
    assert modules == FACADE
    # Six short paths of packages, and the classes that only annotations name.
    assert len(modules - {"__init__", "__main__"}) <= 7


@pytest.mark.long
def test_no_import_outside_the_plan():
    assert [f"{file} imports from {other}" for one, other, file in imports() if other not in PLAN[one]] == []


@pytest.mark.slow
def test_the_plan_names_no_missing_import():
    assert {(one, other) for one, others in PLAN.items() for other in others} - arrows() == set()


def test_packages_import_only_from_packages_above_them():
    order = list(PLAN)
    assert [(one, other) for one, other in arrows() if order.index(other) >= order.index(one)] == []


@pytest.mark.slow
def test_no_cycle_between_subpackages():
    """Subpackages of one package import each other in one direction only."""
    graph = {}
    for file, modules in imports_of_files().items():
        parts = file.with_suffix("").parts
        if len(parts) > 2:
            for whole in modules:
                if whole[0] == parts[0] and whole[1:2] != parts[1:2] and (ROOT / "/".join(whole[:2])).is_dir():
                    graph.setdefault(parts[:2], set()).add(whole[:2])
    assert in_circles(graph) == []


def in_circles(graph):
    """Members of circles of a graph, and members between circles; ``graph`` has the set of what each imports."""
    while True:
        among = {one: others & set(graph) for one, others in graph.items()}
        imported_by_one = set().union(*among.values())
        smaller = {one: others for one, others in among.items() if others and one in imported_by_one}
        if len(smaller) == len(graph):
            return sorted(".".join(one) for one in graph)
        graph = smaller


def module_of(path):
    """The parts of the dotted name of a file's module, without the library's name."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


def lazy_names(stub):
    """A dictionary from the names in the ``__init__.pyi`` of a package to the modules that they are imported from."""
    nodes = (node for node in ast.walk(ast.parse(stub.read_text(encoding="utf-8"))) if isinstance(node, ast.ImportFrom))
    package = module_of(stub.with_suffix(".py"))
    return {alias.asname: (*package, *(node.module or "").split(".")) for node in nodes for alias in node.names}


def graph_of_files(trees, lazy):
    """The set of modules that each module imports at any position: at the top, in functions, and for type checkers.

    ``trees`` has the syntax tree of each module. ``lazy`` has the names that a package imports on first use,
    with their modules: a file that uses such a name imports its module.
    """

    def find(of, name):
        return (*of, name) if (*of, name) in trees else lazy.get(of, {}).get(name, of)

    graph = {}
    for module, tree in trees.items():
        graph[module], packages = set(), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                graph[module] |= {tuple(alias.name.split(".")[1:]) for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "quasiharmonic":
                of = tuple(node.module.split(".")[1:])
                found = {alias.asname or alias.name: find(of, alias.name) for alias in node.names}
                packages |= {name: other for name, other in found.items() if other in lazy}
                graph[module] |= set(found.values())
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in packages:
                graph[module].add(find(packages[node.value.id], node.attr))
        graph[module] = (graph[module] & set(trees)) - {module}
    return graph


@pytest.mark.long
def test_no_circle_of_files():
    trees = {module_of(path): parse(path) for path in ROOT.rglob("*.py")}
    lazy = {module_of(path.with_suffix(".py")): lazy_names(path) for path in ROOT.rglob("__init__.pyi")}
    graph = graph_of_files(trees, lazy)
    assert ("io", "mesh_files") in graph["ui", "cli", "pipeline"]
    assert in_circles(graph) == []


@pytest.mark.parametrize(
    "code",
    [
        "from quasiharmonic.io import files",
        "import quasiharmonic.io.files",
        "def f():\n    from quasiharmonic.io.files import read",
        "if TYPE_CHECKING:\n    from quasiharmonic.io.files import read",
        "from quasiharmonic.io import read",
        "from quasiharmonic import io as files\ndef f():\n    return files.read",
        "from quasiharmonic.io.between import between",
    ],
)
def test_a_circle_of_files_is_found(code):
    texts = {
        (): "",
        ("io",): "",
        ("io", "meshes"): code,
        ("io", "between"): "def f():\n    from quasiharmonic.io import files",
        ("io", "files"): "from quasiharmonic.io.meshes import Mesh",
        ("io", "last"): "from quasiharmonic.io import files",
    }
    trees = {module: ast.parse(text) for module, text in texts.items()}
    assert {"io.files", "io.meshes"} <= set(in_circles(graph_of_files(trees, {("io",): {"read": ("io", "files")}})))
    trees["io", "meshes"] = ast.parse("import numpy")
    assert in_circles(graph_of_files(trees, {})) == []


def test_every_package_states_where_to_start_reading():
    silent = [
        str(path.relative_to(ROOT))
        for path in ROOT.rglob("__init__.py")
        if "Start reading" not in (ast.get_docstring(parse(path)) or "")
        and path.parent != ROOT
        and "c" not in path.relative_to(ROOT).parts
    ]
    assert silent == []


def test_every_kind_of_import_is_detected():
    code = "import numpy, quasiharmonic.io.errors as o\ndef f():\n    from quasiharmonic.ui import plot, nothing"
    assert list(imported(ast.parse(code))) == [("io", "errors"), ("ui", "plot"), ("ui",)]
    assert list(imported(ast.parse("load('quasiharmonic.ui.display')"))) == [("ui", "display")]
    assert list(imported(ast.parse('"quasiharmonic.ui"'))) == []
    assert list(imported(ast.parse("from quasiharmonic import __version__, geometry"))) == [("geometry",)]


@pytest.mark.parametrize("code", ["from quasiharmonic import solve", "import quasiharmonic", "from . import io"])
def test_imports_of_missing_modules_are_errors(code):
    with pytest.raises(AssertionError):
        list(imported(ast.parse(code)))


def test_every_class_has_a_name_of_its_own():
    """A leading underscore makes no difference to a reader."""
    found: dict[str, list[str]] = {}
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(parse(path)):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name.lstrip("_"), []).append(path.relative_to(ROOT).as_posix())
    twice = {name: paths for name, paths in found.items() if len(paths) > 1}
    assert {
        name: paths for name, paths in twice.items() if not all("/packing/" in p or "/search/" in p for p in paths)
    } == {}
