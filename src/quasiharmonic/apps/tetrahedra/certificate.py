"""Exact certificate of a tetrahedral mesh.

A tetrahedral mesh is a map of an abstract complex into space, affine on each tetrahedron. It is *injective* if no two
points have the same image. There is no theorem in space like those for maps into the plane, so the certificate decides
the following conditions exactly. Together they are necessary and sufficient.

1. No tetrahedron is repeated, each face is in at most two tetrahedra, and the two lie on different sides of it.
2. Every tetrahedron is positive.
3. Boundary triangles meet only in their common vertices and edges.
4. The winding number of the boundary is 0 or 1 at every point off it.

*Sufficient*: the winding number at a point off all faces is the degree of the map there. By condition 2 it is the
number of tetrahedra that contain the point, so the interiors of tetrahedra are disjoint. Suppose two points had the
same image. If both are on the boundary, this contradicts condition 3. Otherwise one is in the interior. The directions
around it form a closed surface, whose positive triangles cover the sphere of directions. So the tetrahedra at this
point cover a neighbourhood of the image, and overlap those at the other point.

*Necessary*: each condition fails only if two points have the same image or a tetrahedron is not positive.

Conditions 1 to 3 alone are not sufficient. A shell between two spheres can cover a ball twice, branched along a circle,
with one boundary sphere pushed outwards; then both spheres face outwards and the winding number inside is 2.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.apps.tetrahedra.contacts import MAX_LISTED, find_contacts, outer_winding
from quasiharmonic.apps.tetrahedra.elements import ExactSigns, FaceReport, find_patches, inspect_faces
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    ReadOnly,
    check_bool,
    check_finite,
    check_range,
    count_of,
    index_array,
    make_unchangeable,
    names_of,
    real_array,
)
from quasiharmonic.util.outcome import Verdict, as_plain


@dataclass(frozen=True, eq=False, repr=False)
class TetrahedraCertificate(ReadOnly, Verdict):
    """Result of the exact test of a tetrahedral mesh; returned by `certify_tetrahedra`.

    Attributes
    ----------
    tetrahedra : int
        Number of tetrahedra.
    inverted, degenerate, nonfinite : (k,) int64
        Ascending indices of tetrahedra. Inverted tetrahedra have negative volume, degenerate ones exactly zero volume.
        Nonfinite tetrahedra have a NaN or infinite coordinate.
    repeated : (k,) int64
        Tetrahedra with the same vertices as an earlier one, or with a vertex twice.
    nonmanifold, inconsistent : (k, 3) int64
        Faces of three or more tetrahedra, and faces of two tetrahedra with opposite orientations.
    boundary : (b, 3) int64
        Boundary triangles, counterclockwise seen from outside.
    crossings : (k, 2) int64
        Pairs of boundary triangles, as rows of ``boundary``, that meet outside their common vertices and edges.
        Degenerate boundary triangles are not compared. At most 1000 are listed.
    multiply_covered : (k,) int64
        Boundary triangles, one for each part of the boundary, on whose outer side the winding number is not 0. Only
        computed if the mesh meets the other conditions.
    injective : bool or None
        Whether no two points of the mesh have the same position; None if the boundary was not checked.

    See Also
    --------
    certify_tetrahedra : Makes it.
    Certificate : The verdict on triangles.

    Examples
    --------
    >>> from quasiharmonic import certify_tetrahedra
    >>> certificate = certify_tetrahedra([[0, 2, 1, 3]], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> certificate.valid, certificate.inverted.tolist()
    (False, [0])
    """

    tetrahedra: int
    inverted: IntArray
    degenerate: IntArray
    nonfinite: IntArray
    repeated: IntArray
    nonmanifold: IntArray
    inconsistent: IntArray
    boundary: IntArray
    crossings: IntArray
    multiply_covered: IntArray
    injective: bool | None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, make_unchangeable(value))

    def _read_only(self) -> Iterator[NDArray[Any]]:
        return (value for value in vars(self).values() if isinstance(value, np.ndarray))

    @property
    def valid(self) -> bool:
        """Whether every tetrahedron is strictly positive; equal to `positive`."""
        return self.positive

    @property
    def bijective(self) -> bool | None:
        """Whether no point is covered twice; equal to `injective`."""
        return self.injective

    @property
    def positive(self) -> bool:
        """Whether there is at least one tetrahedron and every tetrahedron is strictly positive."""
        return self.tetrahedra > 0 and not (self.inverted.size or self.degenerate.size or self.nonfinite.size)

    def __bool__(self) -> bool:
        """Return whether the mesh is injective; False if this was not checked."""
        return bool(self.injective)

    def __repr__(self) -> str:
        return f"<TetrahedraCertificate: {self.summary().partition('. ')[0]}>"

    def summary(self) -> str:
        """Describe what is certified, or what is wrong and where."""
        tetrahedra = count_of("tetrahedron", "tetrahedra", self.tetrahedra)
        if not self.tetrahedra:
            return "Not injective: there are no tetrahedra."
        if self.positive:
            first = f"{'The only' if self.tetrahedra == 1 else 'Each of'} {tetrahedra} is positive."
            first = first.replace("only 1 ", "only ")
        else:
            kinds = ((self.inverted, "inverted"), (self.degenerate, "degenerate"), (self.nonfinite, "not finite"))
            bad = "; ".join(
                f"{names_of('tetrahedron', 'tetrahedra', which)} {'is' if len(which) == 1 else 'are'} {what}"
                for which, what in kinds
                if which.size
            )
            first = f"Not injective: of {tetrahedra}, {bad}."
        if self.injective:
            return f"{first} Injective: the boundary does not meet itself, and no point is covered twice."
        further = self._reasons()
        return first if not further else f"{first} Not injective{'' if self.positive else ' either'}: {further}."

    def _reasons(self) -> str:
        """Name the violated conditions except the signs of the tetrahedra."""
        found = []
        if self.repeated.size:
            found.append(f"{names_of('tetrahedron', 'tetrahedra', self.repeated)} repeated, or with a vertex twice")
        if len(self.nonmanifold):
            found.append(f"{_name_faces(self.nonmanifold)} in three or more tetrahedra")
        if len(self.inconsistent):
            found.append(f"two tetrahedra on the same side of {_name_faces(self.inconsistent)}")
        if len(self.crossings):
            i, j = (_name_faces(self.boundary[k : k + 1]) for k in self.crossings[0])
            pairs = count_of("pair", "pairs", len(self.crossings))
            pairs = f"at least {pairs}" if len(self.crossings) >= MAX_LISTED else pairs
            found.append(f"{pairs} of boundary triangles meet, the first of them {i} and {j}")
        if self.multiply_covered.size:
            where = _name_faces(self.boundary[self.multiply_covered])
            found.append(f"the mesh covers points twice, or is inside out, outside the boundary at {where}")
        return "; ".join(found)

    def to_dict(self) -> dict[str, Any]:
        """Return the certificate in plain Python types, fit for JSON; boundary triangles by their vertices."""
        elements = "inverted", "degenerate", "nonfinite", "repeated", "nonmanifold", "inconsistent"
        return {
            **super().to_dict(),
            **as_plain(self, "injective", "positive", "tetrahedra", *elements),
            "boundary_triangles": len(self.boundary),
            "crossings": self.boundary[self.crossings].tolist(),
            "multiply_covered": self.boundary[self.multiply_covered].tolist(),
            "summary": self.summary(),
        }


def certify_tetrahedra(T: ArrayLike, X: ArrayLike, *, boundary: bool = True) -> TetrahedraCertificate:
    """Verify exactly whether a tetrahedral mesh is injective: positive tetrahedra, and no point covered twice.

    Parameters
    ----------
    T : (t, 4) array of int
        Tetrahedra; positive if the vectors from the first vertex to the others, in order, are right-handed, as in Gmsh
        and VTK.
    X : (n, 3) array
        Positions, which need not be finite. Any magnitude is allowed.
    boundary : bool
        Whether to check the boundary, too. If False, only the signs of tetrahedra are decided, and ``injective`` is
        None.

    Returns
    -------
    TetrahedraCertificate

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype, or ``T`` has indices out of range.

    See Also
    --------
    injective_tetrahedra : Searches for positive tetrahedra.
    certify : Checks triangles.

    Notes
    -----
    The result is exact for the coordinates in doubles; integers beyond 2⁵³ are rounded. The module
    `quasiharmonic.apps.tetrahedra.certificate` has the conditions and the proof.

    Examples
    --------
    >>> X = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    >>> certify_tetrahedra([[0, 1, 2, 3], [1, 4, 2, 3]], X).injective
    True
    >>> certify_tetrahedra([[0, 1, 2, 3], [1, 2, 4, 3]], X).inverted
    array([1])
    """
    check_bool("boundary", boundary)
    X = space_array("X", X, finite=False)
    return certify_arrays(tetrahedron_array(T, len(X)), X, boundary=boundary)


def certify_arrays(
    T: IntArray, X: FloatArray, *, boundary: bool = True, faces: FaceReport | None = None
) -> TetrahedraCertificate:
    """`certify_tetrahedra` of checked arrays; ``faces`` is the result of `inspect_faces`, if known."""
    signs = ExactSigns(X)
    sign = signs(T)
    finite = np.asarray(signs.finite[T].all(axis=1))
    if faces is None:
        faces = inspect_faces(T, len(X))
    clean = len(T) > 0 and not (faces.repeated.size or len(faces.nonmanifold) or len(faces.inconsistent))
    crossings, covered = np.empty((0, 2), dtype=np.int64), np.empty(0, dtype=np.int64)
    injective: bool | None = None
    if boundary:
        crossings = find_boundary_contacts(faces.boundary, X, signs)
        injective = clean and bool(np.all(sign > 0)) and not len(crossings)
        if injective:
            patches = find_patches(faces.boundary)
            # A connected closed surface separates space into two parts, and positive tetrahedra fix its orientation.
            if patches.max() > 0:
                wrong = np.flatnonzero(outer_winding(faces.boundary, X, patches))
                covered = np.array([np.flatnonzero(patches == k)[0] for k in wrong], dtype=np.int64)
                injective = not covered.size
    return TetrahedraCertificate(
        tetrahedra=len(T),
        inverted=np.flatnonzero(sign < 0),
        degenerate=np.flatnonzero((sign == 0) & finite),
        nonfinite=np.flatnonzero(~finite),
        **vars(faces),
        crossings=crossings,
        multiply_covered=covered,
        injective=injective,
    )


def find_boundary_contacts(F: IntArray, X: FloatArray, signs: ExactSigns | None = None) -> IntArray:
    """`find_contacts` of the triangles (f, 3) that are finite and not degenerate, in the indices of all triangles."""
    signs = ExactSigns(X) if signs is None else signs
    good = np.flatnonzero(np.asarray(signs.finite[F].all(axis=1)) & ~_degenerate_triangles(F, X))
    return good[find_contacts(F[good], X, signs)]


def tetrahedron_array(T: ArrayLike, n: int) -> IntArray:
    """Convert tetrahedra among ``n`` vertices to (t, 4) int64; returns a copy, or raises a ValueError."""
    array = index_array("T", T)
    if array.size == 0:
        return np.empty((0, 4), dtype=np.int64)
    if array.ndim == 2 and array.shape[1] == 10:
        raise ValueError("second-order tetrahedra are not supported: pass the first four columns to treat the corners")
    if array.ndim == 2 and array.shape[1] == 8:
        raise ValueError("hexahedra are not supported: split them into tetrahedra")
    if array.ndim != 2 or array.shape[1] != 4:
        raise ValueError(f"T must have shape (t, 4), not {array.shape}")
    check_range("T", array, n)
    return array


def space_array(name: str, X: ArrayLike, n: int | None = None, *, finite: bool = True) -> FloatArray:
    """Convert positions in space to (n, 3) float64; returns a copy, or raises a ValueError."""
    array = real_array(name, X)
    if array.ndim != 2 or array.shape[1] != 3 or (n is not None and len(array) != n):
        raise ValueError(f"{name} must have shape ({'n' if n is None else n}, 3), not {array.shape}")
    if finite:
        check_finite(name, "row", "rows", array)
    return array


def _degenerate_triangles(F: IntArray, X: FloatArray) -> NDArray[np.bool_]:
    """Whether triangles (f, 3) in space lie exactly on a line."""
    from quasiharmonic.geometry.exact.predicates import orientation_or_nonfinite

    flat = np.ones(len(F), dtype=np.bool_)
    for axes in ((0, 1), (1, 2), (2, 0)):
        left = np.flatnonzero(flat)
        a, b, c = X[F[left]][:, :, axes].transpose(1, 0, 2)
        flat[left] = orientation_or_nonfinite(a, b, c)[0] == 0
    return flat


def _name_faces(faces: IntArray) -> str:
    return names_of("face", "faces", faces)
