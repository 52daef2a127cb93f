"""The public functions that decide whether a map is injective: triangles may be given as a mesh object or a file.

The decision is in `quasiharmonic.geometry.exact.certificate`, which takes arrays.
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
    """Judge a map exactly, on its coordinates as stored.

    Parameters
    ----------
    F : (f, 3) int, or a mesh
        Triangles, any integer dtype; or a mesh object, or the path of a file, for its triangles.
    uv : (n, 2) float
        Place of every vertex, any dtype that double precision holds exactly. What a consumer in
        single precision would see is ``certify(F, uv.astype(np.float32))``. Vertices of no triangle
        are not looked at.
    boundary : bool
        Judge the boundary too, so that `Certificate.bijective` is known. All components count
        together: islands that overlap are not bijective.
    loops : sequence of (l,) int, optional
        The boundary loops of a mesh that is known to be a surface, as `boundary_loops` gives them, at least one and of
        three vertices or more. That they are the loops of ``F`` is taken on trust, and to find them is half of the
        work.

    Returns
    -------
    Certificate
        Which triangles are not positive, and why the map is not bijective where it is not.

    Raises
    ------
    ValueError
        When ``F``, ``uv`` or a loop has the wrong shape or dtype, there are no loops in ``loops``, or ``F`` or
        ``loops`` name vertices that are not there.

    See Also
    --------
    is_injective, inverted_triangles : the triangles alone, as an inner loop wants them.

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
    """Whether there are triangles and every one is strictly positive, decided exactly.

    The predicate to the locator `inverted_triangles`.

    Parameters
    ----------
    F : (f, 3) array of int, or a mesh
    uv : (n, 2) array
        Taken as they are stored, integers and float32 too, as in `certify`.

    Returns
    -------
    bool

    Raises
    ------
    ValueError
        When shapes are wrong or an index is out of range, as in `certify`.
    """
    return certificate.is_injective(mesh_triangles(F), uv)


def inverted_triangles(F: ArrayLike, uv: ArrayLike) -> IntArray:
    """Find the triangles that keep a map from being injective, exactly.

    Parameters
    ----------
    F : (f, 3) array of int, or a mesh
    uv : (n, 2) array
        Taken as they are stored, integers and float32 too, as in `certify`.

    Returns
    -------
    (k,) int64
        Ascending indices of *all* triangles that are not strictly positive: clockwise, without area
        or not finite. `certify` tells them apart.

    Raises
    ------
    ValueError
        When shapes are wrong or an index is out of range, as in `certify`.
    """
    return certificate.inverted_triangles(mesh_triangles(F), uv)
