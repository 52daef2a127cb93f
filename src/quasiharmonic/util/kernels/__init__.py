"""Compiled loops in C, each with an equivalent NumPy function.

A kernel is a function that fills arrays passed to it. Its NumPy version stands in the module that uses it, defines the
result, and has the decorator `compiled`. If the extension was built, the C function of the same name replaces it. The
extension is built from the C files of this folder.

*Checks in a kernel*: a kernel raises a TypeError or ValueError for a wrong number of arguments. It also checks the type
and alignment of arrays, and that they are contiguous unless its C code says otherwise. Output arrays must be writeable,
and the sizes of the arrays must fit together (`fit` in `arguments.h`). Some kernels also check that indices are in
range, as their C code says. They return a number that reports the error, and the caller raises.

*Preconditions*: all other indices are in range. Floats that become integers are finite and within the bounds stated in
the C code. No array changes during the call. A kernel lets other threads run, so no check is reliable for an array that
other code can write to. The callers ensure this: a public function copies its index arrays once, checks the copies, and
passes only these on. `index_array`, `triangle_array`, `vertex_array` and similar functions in
`quasiharmonic.util.arrays` always copy. `own_triangles` and `make_unchangeable` do not copy arrays that they made
before, such as the triangles of a `Domain` or a `Certificate`. A read-only array may be a view of a writeable one, so
it is copied.

Kernels copy arrays of 32-bit integers, which NumPy 1 makes by default on Windows, as in Blender.

Set ``QUASIHARMONIC_PURE=1`` in the environment to run the NumPy versions. Both versions give the same results up to
rounding, and identical results in the package `exact`.

Constants that both versions use are assigned in Python; `constants` writes them into a C header during the build.

The C files are in `c`; `_compiled.pyi` lists their functions. Start reading in `c/module.c`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

try:
    if os.environ.get("QUASIHARMONIC_PURE", "0") not in ("", "0"):
        raise ImportError("switched off")
    from quasiharmonic.util.kernels import _compiled as extension
except ImportError:
    extension = None  # type: ignore[assignment]

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

#: NumPy versions of the kernels by name, for the modules that have been imported.
TWINS: dict[str, Callable[..., Any]] = {}


def compiled(twin: Kernel) -> Kernel:
    """Return the function of this name in the extension, or the NumPy function if there is no extension.

    Raises an ImportError if the extension has no such function, because it was built from older C files.
    """
    TWINS[twin.__name__] = twin
    if extension is None:
        return twin
    kernel: Kernel | None = getattr(extension, twin.__name__, None)
    if kernel is None:
        raise ImportError(
            f"{extension.__file__} is too old: it has no {twin.__name__}; build it again: pip install -e ."
        )
    return kernel
