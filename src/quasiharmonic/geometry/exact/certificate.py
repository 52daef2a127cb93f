"""Exact certificate of a map of a triangle mesh into the plane.

A map is *injective* when every triangle is strictly positive. This is verified exactly on the coordinates as stored.
It is *bijective* onto its image when, in addition, no two points of the surface have the same image. The boundary
alone decides this:

    Let all triangles of a compact oriented surface be positive. Take a point of the plane that lies on no edge's
    image. The winding number of the boundary's image around the point equals the number of its preimages, because
    both are the degree of the map there [1]_. So the map is bijective if and only if the images of the boundary loops
    are simple and mutually disjoint, and their winding number is 0 or 1 around every point off them.

    *Only if*: a bijective map keeps loops simple and disjoint, and no point has two preimages.

    *If*: almost no point has two preimages. Suppose two points of the surface had the same image. If one of them is
    interior, the images of their neighbourhoods overlap in an open set, which is covered twice. If both are on the
    boundary, the loops are not simple and disjoint. For the same reason the triangles around an interior vertex wind
    around it once: positive triangles can wind twice, but then they cover the points nearby twice.

The criterion does not depend on the number of components or on the genus. A surface that cannot lie in the plane fails
the test. For simple, disjoint loops the winding numbers follow from the nesting. A loop inside an even number of loops
must run counterclockwise, and a loop inside an odd number clockwise. For a connected surface this leaves one
counterclockwise loop around all others. Any of its loops may be the outer one: an annulus turned inside out is still
bijective.

Many small maps are certified at once, at a lower cost than one by one. Most maps are valid and have one boundary loop.
A map is bijective if all triangles are positive and its only loop is simple (`certify`). These two exact tests of
triangles and boundary edges run on all maps together. `certify` then checks the remaining maps one by one.

References
----------
.. [1] Y. Lipman, Bijective mappings of meshes with boundary and the degree in mesh processing.
   SIAM Journal on Imaging Sciences 7 (2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.geometry.exact.loops import Obstacle, Reason, check_loops, join_items, simple_loops
from quasiharmonic.geometry.exact.triangles import find_multiply_wound, triangle_signs
from quasiharmonic.geometry.mesh.topology import are_collapsed, edges, trace_loops
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    ReadOnly,
    count_of,
    make_unchangeable,
    vertex_names,
)
from quasiharmonic.util.outcome import Displayable, Verdict, as_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _none() -> IntArray:
    """No elements."""
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(ReadOnly, Displayable, Verdict):
    """Result of the exact test of a map; returned by `certify`.

    Attributes
    ----------
    F : (f, 3) int64
    uv : (n, 2) float64
        Triangles and map that were checked, as copies. All arrays are read-only and cannot be made writeable.
    bijective : bool or None
        Whether the map is injective and covers no point twice; None if the boundary was not checked.
    inverted, degenerate, nonfinite : (k,) int64
        Ascending indices of triangles. Inverted triangles are clockwise. Degenerate triangles have exactly zero area;
        they include those that repeat a vertex. Nonfinite triangles have a NaN or infinite coordinate.
    reasons : tuple of Reason
        Why the map is not bijective. The loops are checked even if triangles are inverted.
    loops : tuple of (l,) int64
        Boundary vertices, loop by loop, the surface to the left.
    crossings : (m, 4) int64
        Rows ``i, j, k, l``: the boundary edges ``i → j`` and ``k → l`` share a point that they should
        not share. At most 1000 are listed.
    multiply_wound : (k,) int64
        Vertices with only positive triangles around them whose angles add up to more than 2π. At an interior vertex the
        triangles wind more than once; at a boundary vertex the two ends of the fan overlap. See the notes.

    See Also
    --------
    certify : Makes it.
    TetrahedraCertificate : The verdict on tetrahedra.

    Notes
    -----
    Suppose all triangles around a vertex are positive. At an interior vertex the sum of their angles is a multiple of
    2π, and the map is locally injective if and only if it is 2π. At a boundary vertex the map is locally injective if
    and only if the sum is less than 2π. A sum of exactly 2π means that the two boundary edges lie on each other. Then
    `crossings` lists them, and `multiply_wound` does not contain the vertex. The test is exact. `multiply_wound` is
    empty if the boundary was not checked (`bijective` is None) or if the mesh is not a surface.

    Examples
    --------
    >>> from quasiharmonic import certify
    >>> certificate = certify([[0, 1, 2], [0, 2, 3]], [[0, 0], [1, 0], [1, 1], [0.9, 0.5]])
    >>> certificate.injective, certificate.inverted.tolist()
    (False, [1])
    """

    F: IntArray
    uv: FloatArray
    bijective: bool | None
    inverted: IntArray = field(default_factory=_none)
    degenerate: IntArray = field(default_factory=_none)
    nonfinite: IntArray = field(default_factory=_none)
    reasons: tuple[Reason, ...] = ()
    loops: tuple[IntArray, ...] = ()
    crossings: IntArray = field(default_factory=lambda: _none().reshape(0, 4))
    multiply_wound: IntArray = field(default_factory=_none)

    def __post_init__(self) -> None:
        self._seal()

    def _seal(self) -> None:
        """Keep every array in memory that nobody can write to, whatever flags they set."""
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                object.__setattr__(self, name, make_unchangeable(value))
        object.__setattr__(self, "loops", tuple(make_unchangeable(loop) for loop in self.loops))

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return len(self.F)

    @property
    def injective(self) -> bool:
        """Whether there is at least one triangle and every triangle is strictly positive."""
        return self.triangles > 0 and not (self.inverted.size or self.degenerate.size or self.nonfinite.size)

    @property
    def valid(self) -> bool:
        """Whether every triangle is strictly positive; equal to `injective`."""
        return self.injective

    def summary(self) -> str:
        """Describe in one or two sentences what is certified, or what is wrong and where."""
        further = [r.text for r in self.reasons if r.kind is not Obstacle.NOT_INJECTIVE]
        if self.injective:
            triangles = "the only triangle is" if self.triangles == 1 else f"all {self.triangles} triangles are"
            first_sentence = f"Injective: {triangles} positive."
        elif self.triangles:
            bad_triangles = _count_by_kind(self.inverted, self.degenerate, self.nonfinite)
            first_sentence = f"Not injective: of {self.triangles} triangles, {bad_triangles}."
        else:
            return "Not injective: there are no triangles."
        if self.bijective:
            return f"{first_sentence} Bijective: the boundary does not meet itself, and no point is covered twice."
        if not further:
            return first_sentence
        more = f"; and {len(further) - 3} more" if len(further) > 3 else ""
        return f"{first_sentence} Not bijective{'' if self.injective else ' either'}: {'; '.join(further[:3])}{more}."

    def short_repr(self) -> str:
        bad = self.inverted.size + self.degenerate.size + self.nonfinite.size
        triangles = count_of("triangle", "triangles", self.triangles)
        if bad or not self.triangles:
            return f"not injective, {bad} of {triangles} not positive"
        also = {True: " and bijective", False: ", not bijective", None: ""}[self.bijective]
        return f"injective{also}, {triangles}"

    def plot(self) -> Figure:
        """Draw the certified map, with non-positive triangles in red and marks on boundary edges that meet."""
        return self._draw("certificate")

    def to_dict(self) -> dict[str, Any]:
        """Return the certificate in plain Python types, fit for JSON; each loop as its first vertex and its length."""
        return {
            **super().to_dict(),
            **as_plain(self, "injective", "triangles", "inverted", "degenerate", "nonfinite"),
            "reasons": [{"kind": r.kind.value, "text": r.text, "loops": list(r.loops)} for r in self.reasons],
            "loops": [{"start": int(loop[0]), "length": len(loop)} for loop in self.loops],
            **as_plain(self, "crossings", "multiply_wound"),
            "summary": self.summary(),
        }


def certify(
    F: IntArray,
    uv: FloatArray,
    *,
    boundary: bool = True,
    loops: Sequence[IntArray] | None = None,
    numbers: IntArray | None = None,
) -> Certificate:
    """Verify exactly whether a map is injective and bijective; `quasiharmonic.certify` converts and checks its input.

    Parameters
    ----------
    F : (f, 3) int64
        Triangles; only the range of their indices is checked.
    uv : (n, 2) float64
        Positions, which need not be finite.
    boundary : bool
        Whether to check the boundary, too.
    loops : sequence of (l,) int64, optional
        The boundary loops of ``F``, at least one if there are triangles; not checked.
    numbers : (f,) int64, optional
        Ascending numbers of the triangles in the certificate; by default their rows.
    """
    F, uv = make_unchangeable(F), make_unchangeable(uv)
    numbers = np.arange(len(F)) if numbers is None else numbers
    sign, nonfinite = triangle_signs(F, uv)
    nonfinite = numbers[nonfinite]
    inverted = degenerate = _none()
    reasons: list[Reason] = []
    if not len(F):
        reasons.append(Reason(Obstacle.NO_TRIANGLES, "there are no triangles"))
    elif sign.min() <= 0:
        inverted = numbers[sign < 0]
        degenerate = np.setdiff1d(numbers[sign == 0], nonfinite, assume_unique=True)
        text = f"of {len(F)} triangles, {_count_by_kind(inverted, degenerate, nonfinite)}"
        reasons.append(Reason(Obstacle.NOT_INJECTIVE, text))
    known: list[IntArray] = []
    crossings, multiply_wound = _none().reshape(0, 4), _none()
    if boundary and len(F):
        known, defects = _find_loops(F, len(uv), numbers) if loops is None else (list(loops), [])
        reasons += defects
        # If all triangles are positive and the only loop is simple, the loop encloses the sum of their areas. So it
        # runs counterclockwise and winds once around its inside, and no further test is needed.
        is_simple = not reasons and len(known) == 1 and bool(simple_loops(known, uv)[0])
        if not defects and not is_simple:
            multiply_wound = find_multiply_wound(F, uv, sign, known)
            if np.isfinite(uv[np.concatenate(known)]).all():
                crossings, found = check_loops(known, uv)
                reasons += found
        if multiply_wound.size:
            text = f"triangles wind more than once around {vertex_names(multiply_wound)}"
            reasons.append(Reason(Obstacle.MULTIPLY_WOUND, text))
    return Certificate(
        F,
        uv,
        not reasons if boundary else None,
        inverted=inverted,
        degenerate=degenerate,
        nonfinite=nonfinite,
        reasons=tuple(reasons),
        loops=tuple(known),
        crossings=crossings,
        multiply_wound=multiply_wound,
    )


def is_injective(F: IntArray, uv: FloatArray) -> bool:
    """Return whether there are triangles and all are strictly positive; the arguments are as for `certify`."""
    return len(F) > 0 and bool(triangle_signs(F, uv)[0].min() > 0)


def inverted_triangles(F: IntArray, uv: FloatArray) -> IntArray:
    """Return the indices of the triangles that are not strictly positive; the arguments are as for `certify`."""
    return np.flatnonzero(triangle_signs(F, uv)[0] <= 0)


def _count_by_kind(inverted: IntArray, degenerate: IntArray, nonfinite: IntArray) -> str:
    """Count and list the non-positive triangles by kind."""
    return ", ".join(
        f"{count_of('is', 'are', bad.size)} {what} ({join_items(bad.tolist())})"
        for bad, what in ((inverted, "inverted"), (degenerate, "degenerate"), (nonfinite, "not finite"))
        if bad.size
    )


def _find_loops(F: IntArray, n: int, numbers: IntArray) -> tuple[list[IntArray], list[Reason]]:
    """Boundary loops, or the reasons why there are no valid loops."""
    parts, repeated = edges(F, n), _none()
    # An edge from a vertex to itself is never interior, so only the other kinds of edges need a test.
    if any((some[:, 0] == some[:, 1]).any() for some in (parts.boundary, parts.inconsistent, parts.nonmanifold)):
        repeated = numbers[are_collapsed(F)]
    wrong = (
        (repeated.tolist(), "triangles repeat a vertex"),
        (_edge_names(parts.nonmanifold), "edges are in three or more triangles"),
        (_edge_names(parts.inconsistent), "edges are traversed twice in the same direction"),
    )
    defects = [f"{what} ({join_items(found)})" for found, what in wrong if found]
    if not defects:
        try:
            loops = trace_loops(parts.boundary)
        except ValueError as error:
            defects = [str(error)]
    if defects:
        return [], [Reason(Obstacle.NOT_A_SURFACE, f"the mesh is not a surface: {text}") for text in defects]
    if not loops:
        return [], [Reason(Obstacle.NO_BOUNDARY, "the surface has no boundary")]
    return loops, []


def _edge_names(pairs: IntArray) -> list[str]:
    return [f"{i}–{j}" for i, j in pairs.tolist()]
