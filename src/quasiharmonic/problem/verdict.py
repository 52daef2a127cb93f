"""Public functions that certify a map; triangles may be given as a mesh object or a file.

The computation is in `quasiharmonic.geometry.exact.certificate`, which takes arrays.
"""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from quasiharmonic.geometry.exact import certificate
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.io.adapters.objects import mesh_triangles
from quasiharmonic.util.arrays import IntArray


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
    is_injective, inverted_triangles : check the triangles only, for inner loops.

    Examples
    --------
    >>> F = [[0, 1, 2], [0, 2, 3]]
    >>> certify(F, [[0, 0], [1, 0], [1, 1], [0, 1]]).bijective
    True
    >>> print(certify(F, [[0, 0], [1, 0], [1, 1], [0.9, 0.5]]).summary())
    Not injective: of 2 triangles, 1 is inverted (1).
    """
    return certificate.certify(mesh_triangles(F), uv, boundary=boundary, loops=loops)


def is_injective(F: ArrayLike, uv: ArrayLike) -> bool:
    """Return whether the map has triangles and all are strictly positive, decided exactly.

    `inverted_triangles` returns which triangles are not.

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
    """
    return certificate.is_injective(mesh_triangles(F), uv)


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
    """
    return certificate.inverted_triangles(mesh_triangles(F), uv)
