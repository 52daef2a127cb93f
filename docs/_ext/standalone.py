"""Scripts of the gallery that run when they are pasted: functions of shared modules are copied into them."""

from __future__ import annotations

import ast
import shutil
from pathlib import Path

#: Modules of the examples whose functions are copied.
SHARED = "common", "sculptures"
SECTIONS = {"applications": "Applications", "paper": "Figures and tables of the paper"}
PAPER = "figure_", "table_", "edge_elements", "general_tensor"


def write_gallery(examples: Path, folder: Path) -> None:
    """Write the scripts of ``examples`` into ``folder``, a section each for applications and for the paper."""
    shutil.rmtree(folder, ignore_errors=True)
    shared = {name: _definitions((examples / f"{name}.py").read_text(encoding="utf-8")) for name in SHARED}
    for section, title in SECTIONS.items():
        (folder / section).mkdir(parents=True)
        text = f"{title}\n{'-' * len(title)}\n"
        (folder / section / "README.rst").write_text(text, encoding="utf-8")
    shutil.copy(examples / "README.rst", folder)
    for path in sorted(examples.glob("*.py")):
        if path.stem not in SHARED:
            section = "paper" if path.name.startswith(PAPER) else "applications"
            text = standalone(path.read_text(encoding="utf-8"), shared)
            (folder / section / path.name).write_text(text, encoding="utf-8")


def standalone(source: str, shared: dict[str, dict[str, str]]) -> str:
    """Return a script with the shared definitions that it uses in place of their imports."""
    if "BENCHMARKS" in source:
        return source  # It reads records of a checkout.
    lines, tree = source.split("\n"), ast.parse(source)
    needed, imports = {}, {}
    for node in reversed(tree.body):
        first, last = node.lineno - 1, node.end_lineno
        if isinstance(node, ast.ImportFrom) and node.module in shared:
            names = [alias.name for alias in node.names if alias.name != "run"]
            for name in names:
                _collect(name, node.module, shared, needed, imports)
            lines[first:last] = []
        elif isinstance(node, ast.If) and "__main__" in lines[first]:
            lines[first:last] = ['print(main(Path("figures")))']
    own = "\n".join(lines)
    # After the last import of the script, in the order of the shared modules.
    own_imports = [node for node in ast.parse(own).body if isinstance(node, ast.Import | ast.ImportFrom)]
    present = {alias.asname or alias.name for node in own_imports for alias in node.names}
    if clash := needed.keys() & _definitions(own).keys():
        raise ValueError(f"{sorted(clash)} have the names of shared definitions: rename them in the script")
    order = dict.fromkeys(name for module in shared.values() for name in module if name in needed)
    block = sorted({text for name, text in imports.items() if name not in present})
    # Constants that stand together in the shared module are one text.
    block += ["\n", "\n\n\n".join(dict.fromkeys(needed[name] for name in order)), "\n"] if order else []
    lines, end = own.split("\n"), own_imports[-1].end_lineno
    return "\n".join([*lines[:end], *block, *lines[end:]])


def _definitions(source: str) -> dict[str, str]:
    """Return the source of each top-level name of a module; imports are lines that begin with "import" or "from"."""
    found = {}
    for node in ast.parse(source).body:
        first = min([node.lineno, *(mark.lineno for mark in getattr(node, "decorator_list", []))])
        text = "\n".join(source.split("\n")[first - 1 : node.end_lineno])
        if isinstance(node, ast.ImportFrom):
            found |= {a.asname or a.name: f"from {node.module} import {_as(a)}" for a in node.names}
        elif isinstance(node, ast.Import):
            found |= {a.asname or a.name.partition(".")[0]: f"import {_as(a)}" for a in node.names}
        elif isinstance(node, ast.Assign):
            found |= {name.id: text for t in node.targets for name in ast.walk(t) if isinstance(name, ast.Name)}
        elif isinstance(node, ast.AnnAssign | ast.FunctionDef | ast.ClassDef):
            found[node.target.id if isinstance(node, ast.AnnAssign) else node.name] = text
    return found


def _as(alias: ast.alias) -> str:
    return f"{alias.name} as {alias.asname}" if alias.asname else alias.name


def _collect(
    name: str, module: str, shared: dict[str, dict[str, str]], needed: dict[str, str], imports: dict[str, str]
) -> None:
    """Add a definition and all that it uses to ``needed`` and ``imports``."""
    if name in needed or name in imports:
        return
    text = shared[module][name]
    if text.startswith(("import ", "from ")):
        source = text.split()[1]
        if source in shared:
            _collect(name, source, shared, needed, imports)
        else:
            imports[name] = text
        return
    needed[name] = text
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Name) and node.id in shared[module]:
            _collect(node.id, module, shared, needed, imports)
