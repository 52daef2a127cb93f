"""Loops in C, where a compiler was at hand when the package was built, each with a twin in NumPy that says the same.

A kernel is a function that fills arrays handed to it. Its NumPy text stands where it is used, defines what it does, and
is decorated by `compiled`; the function of that name in the extension, made of the C files of this folder, takes its
place where there is one.

*What a kernel checks itself*, and refuses with a TypeError or a ValueError: that it was given as many arguments as it
takes, by position; that arrays are of the very types, aligned, and contiguous unless its C text says otherwise; that
those it fills are writeable; that the arrays' sizes fit together (`fit` in `arguments.h`). Where its C text says so,
also that indices are in range; it then answers by a number that says that they are not, for its caller to raise.

*What it relies on*: that all other indices are in range, that floats which become integers are finite and within the
bounds that its text names, and that no array changes while it runs. It lets other threads run meanwhile, so every
check, its own included, is worth nothing for an array that somebody else can write to. Its callers see to this: a
public function copies its index arrays once, at the border, checks the copy, and hands on nothing else. `index_array`,
`triangle_array`, `vertex_array` and their like in `quasiharmonic.util.arrays` copy always; `own_triangles` and
`unchangeable` do not copy what they made before, such as the triangles of a `Domain` or a `Certificate`. An array that
is merely not writeable may be a view of one that is, and is copied.

``QUASIHARMONIC_PURE=1`` in the environment has the NumPy texts run. Both give the same results but for rounding, and in
the room `exact` the same in every bit.

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

#: The NumPy texts by name, of the modules that have been imported.
TWINS: dict[str, Callable[..., Any]] = {}


def compiled(twin: Kernel) -> Kernel:
    """The function of this name in the extension, or the function as it is where there is no extension.

    Raises
    ------
    ImportError
        The extension was built of other C files than those beside these Python files, and has no such function.
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
