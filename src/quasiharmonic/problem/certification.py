"""Public functions that certify a map; triangles may be given as a mesh object or a file.

They convert and check their arguments. The computation is in `quasiharmonic.geometry.exact.certificate`, whose
functions take checked arrays; code inside the library calls those.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact import certificate
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.io.objects import mesh_triangles
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_bool,
    check_range,
    loop_arrays,
    make_unchangeable,
    map_array,
    own_triangles,
    vertex_names,
)


def certify(
    F: ArrayLike, uv: ArrayLike, *, boundary: bool = True, loops: Sequence[ArrayLike] | None = None
) -> Certificate:
    """Certify exactly whether a map is injective and bijective, on its coordinates as stored.

    Parameters
    ----------
    F : (f, 3) int, or a mesh
        Triangles, any integer dtype; or a mesh object or the path of a file that has the triangles.
    uv : (n, 2) float
        Position of every vertex, in any dtype that converts to double precision exactly. To certify a map for single
        precision, call ``certify(F, uv.astype(np.float32))``. Vertices of no triangle are ignored.
    boundary : bool
        Check the boundary too, which `Certificate.bijective` requires. All components count together: overlapping
        islands are not bijective.
    loops : sequence of (l,) int, optional
        The boundary loops of ``F``, as `boundary_loops` returns them: at least one loop, each of three or more
        vertices. ``F`` must be a surface, and the loops must be its own; neither is checked. Passing them saves about
        half of the time.

    Returns
    -------
    Certificate
        The triangles that are not positive, and the reason if the map is not bijective.

    Raises
    ------
    ValueError
        If ``F``, ``uv`` or a loop has the wrong shape or dtype, if ``loops`` is empty, or if ``F`` or ``loops`` has
        vertex indices out of range.

    See Also
    --------
    is_injective : Checks the triangles only.
    inverted_triangles : Checks the triangles only.
    certify_tetrahedra : Checks tetrahedra.
    quasiharmonic.atlas.certify : Checks a map with seams.

    Examples
    --------
    >>> F = [[0, 1, 2], [0, 2, 3]]
    >>> certify(F, [[0, 0], [1, 0], [1, 1], [0, 1]]).bijective
    True
    >>> print(certify(F, [[0, 0], [1, 0], [1, 1], [0.9, 0.5]]).summary())
    Not injective: of 2 triangles, 1 is inverted (1).
    """
    check_bool("boundary", boundary)
    triangles, positions = _convert(F, uv)
    # Release the writable copy before the computation begins.
    positions = make_unchangeable(positions)
    given = None if loops is None else loop_arrays(loops, len(positions))
    if given == [] and len(triangles):
        raise ValueError("loops has no boundary loop: omit it to find the loops automatically")
    return certificate.certify(triangles, positions, boundary=boundary, loops=given)


def is_injective(F: ArrayLike, uv: ArrayLike) -> bool:
    """Return whether the map has triangles and all are strictly positive, decided exactly.

    `inverted_triangles` returns the triangles that are not.

    Parameters
    ----------
    F : (f, 3) array of int, or a mesh
    uv : (n, 2) array
        Positions as stored, in any dtype that `certify` accepts, integers and float32 included.

    Returns
    -------
    bool

    Raises
    ------
    ValueError
        If a shape is wrong or an index is out of range, as in `certify`.

    See Also
    --------
    inverted_triangles : Which triangles are not strictly positive.
    certify : Also checks whether the map is bijective.

    Examples
    --------
    >>> from quasiharmonic import is_injective
    >>> is_injective([[0, 1, 2]], [[0, 0], [1, 0], [0, 1]]), is_injective([[0, 1, 2]], [[0, 0], [0, 1], [1, 0]])
    (True, False)
    """
    return certificate.is_injective(*_convert(F, uv))


def inverted_triangles(F: ArrayLike, uv: ArrayLike) -> IntArray:
    """Return the triangles that are not strictly positive, decided exactly.

    Parameters
    ----------
    F : (f, 3) array of int, or a mesh
    uv : (n, 2) array
        Positions as stored, in any dtype that `certify` accepts, integers and float32 included.

    Returns
    -------
    (k,) int64
        Ascending indices of *all* triangles that are not strictly positive: inverted, degenerate or not finite.
        `certify` lists the three kinds separately.

    Raises
    ------
    ValueError
        If a shape is wrong or an index is out of range, as in `certify`.

    See Also
    --------
    is_injective : Whether there are none.
    certify : Also checks whether the map is bijective.
    repair : Repairs them.

    Examples
    --------
    >>> from quasiharmonic import inverted_triangles
    >>> inverted_triangles([[0, 1, 2], [0, 2, 3]], [[0, 0], [1, 0], [1, 1], [0.9, 0.5]]).tolist()
    [1]
    """
    return certificate.inverted_triangles(*_convert(F, uv))


def _convert(F: ArrayLike, uv: ArrayLike) -> tuple[IntArray, FloatArray]:
    """Convert triangles or a mesh to (f, 3) int64 and positions to (n, 2) float64, exactly, or raise a ValueError."""
    triangles = own_triangles(mesh_triangles(F))
    given = getattr(uv, "uv", uv)
    positions = map_array("uv", given, finite=False)
    rounded = _find_rounded(given, positions)
    if rounded.size:
        # Report a vertex that does not exist first: it is the simpler mistake.
        check_range("F", triangles, len(positions))
        raise ValueError(f"uv does not fit double precision at {vertex_names(rounded)}")
    return triangles, positions


def _find_rounded(given: ArrayLike, positions: FloatArray) -> IntArray:
    """Return the vertices whose positions (n, 2) double precision may have rounded."""
    stored = np.asarray(given)
    if stored.dtype.kind == "f" and stored.dtype.itemsize > 8:
        return np.flatnonzero(((positions != stored) & ~np.isnan(positions)).any(axis=1))
    if stored.dtype.kind == "f" and not isinstance(given, list | tuple):
        return np.empty(0, dtype=np.int64)
    large = np.argwhere(np.abs(positions) >= 2.0**53)
    # NumPy converts a list of integers and floats to doubles, which rounds large integers.
    source = given if stored.dtype.kind == "f" else stored
    rounded = [vertex for vertex, axis in large.tolist() if _is_rounded(source, positions, vertex, axis)]
    return np.unique(np.array(rounded, dtype=np.int64))


def _is_rounded(given: Any, positions: FloatArray, vertex: int, axis: int) -> bool:
    """Return whether an integer in an array or nested lists differs from the double that it was converted to."""
    number = given[vertex][axis]
    return not isinstance(number, float | np.floating) and int(number) != int(positions[vertex, axis])
