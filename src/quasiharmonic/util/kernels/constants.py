"""Constants that the C kernels share with their NumPy versions: read from the Python source, written to a C header.

This file runs as a script before the extension is built, so it imports only the standard library. The compiled
extension lists the values in ``constants``; a test compares them with the Python source.
"""

from __future__ import annotations

import ast
from pathlib import Path

#: Name in C: Python file below the package folder. Its constant or field has the same name, up to case and underscore.
SHARED = {
    "TINY": "solver/field/tensor.py",
    "TANH_BOUND": "solver/field/tensor.py",
    "RELATIVE_BOUND": "geometry/exact/predicates.py",
    "UNDERFLOW_BOUND": "geometry/exact/predicates.py",
    "BITS": "geometry/exact/point_location.py",
    "MARGIN": "geometry/exact/point_location.py",
    "UNDERFLOW_MARGIN": "geometry/exact/point_location.py",
    "UNSURE": "geometry/exact/point_location.py",
    "UNDECIDED": "geometry/exact/point_location.py",
    "MOST_NEIGHBOURS": "geometry/coarsening.py",
    "PASSES": "geometry/coarsening.py",
    "PER_NEIGHBOUR": "geometry/coarsening.py",
    "GOOD": "geometry/prolongation.py",
    "TOWARDS_MIDDLE": "geometry/prolongation.py",
    "INWARDS": "geometry/prolongation.py",
    "LEAST_HEIGHT": "apps/atlas/packing/shapes.py",
    "SWEEPS": "solver/methods/relocation.py",
    "IN_VAIN": "solver/methods/relocation.py",
    "SHARING": "solver/methods/relocation.py",
    "MOST_AROUND": "solver/methods/relocation.py",
    "PATTERN_RIGHT": "linsolve/base.py",
    "PATTERN_EMPTY_ROW": "linsolve/base.py",
    "PATTERN_NO_DIAGONAL": "linsolve/base.py",
    "PATTERN_NOT_ASCENDING": "linsolve/base.py",
}


def shared_constants(package: Path) -> dict[str, object]:
    """Return the values of all shared constants: int, float, or nested tuples of them."""
    files = {path: _assignments((package / path).read_text(encoding="utf-8")) for path in set(SHARED.values())}
    return {name: files[path][name] for name, path in SHARED.items()}


def _assignments(text: str) -> dict[str, object]:
    """Return the constants of a Python file and the defaults of fields, in capitals."""
    values: dict[str, object] = {}
    body = ast.parse(text).body
    fields = [field for node in body if isinstance(node, ast.ClassDef) for field in node.body]
    for node in [*fields, *body]:
        target = node.target if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [None])[0]
        value = getattr(node, "value", None)
        if isinstance(target, ast.Name) and isinstance(value, ast.expr):
            try:
                code = compile(ast.Expression(value), "constant", "eval")
                values[target.id.lstrip("_").upper()] = eval(code, {"__builtins__": {}})
            except Exception:
                continue
    return values


def _header(values: dict[str, object]) -> str:
    """Return the C header that defines the constants as macros, and lists the scalars for the extension."""
    lines = ["/* Written by kernels/constants.py from the Python source; do not edit. */"]
    lines += [f"#define {name} {_in_c(value)}" for name, value in values.items()]
    scalars = [name for name, value in values.items() if not isinstance(value, tuple)]
    lines.append("#define SHARED_CONSTANTS(with) " + " ".join(f"with({name})" for name in scalars))
    return "\n".join(lines) + "\n"


def _in_c(value: object) -> str:
    if isinstance(value, tuple):
        return "{" + ", ".join(_in_c(one) for one in value) + "}"
    return f"({value!r})"


if __name__ == "__main__":
    folder = Path(__file__).resolve().parents[2]
    (folder / "util/kernels/c/constants.h").write_text(_header(shared_constants(folder)), encoding="utf-8")
