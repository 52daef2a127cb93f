"""From a map of a coarse mesh to one of the fine mesh: vertices are put back in the reverse order of their removal.

Each goes where its triangles are best shaped, which is in the middle of its ring where that is convex, and next
to the apex where nothing else is left. If the coarse map is injective, so is the fine one, but for rounding.
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from quasiharmonic.hearing import still_at_it
from quasiharmonic.mesh.coarsening import Coarsening, touching

# A triangle's squared sides over twice its area are 2√3 = 3.5 when it is equilateral. Below this on average a vertex
# has a good place.
_GOOD = 8.0
# Places to try otherwise: so far from the apex towards the ring's middle, ...
_TOWARDS_MIDDLE = 1.0, 0.75, 0.5, 0.25, 0.1
# ... and straight into the ring, in units of the distance to the nearest side, where the last ones are sure to do.
_INWARDS = 8.0, 4.0, 2.0, 1.0, 0.5, 0.25
# How far smoothing moves a vertex towards the middle of its neighbours, and how often.
_SHARE, _SWEEPS = 0.6, 2


def prolong(w: ComplexArray, coarsening: Coarsening, held: BoolArray) -> ComplexArray:
    """Carry a map from the coarse mesh to the fine one.

    Parameters
    ----------
    w : (n,) complex128
        ``u + i v``, of which the values at the coarse mesh's vertices are read.
    coarsening : Coarsening
    held : (n,) bool
        Vertices that are not moved.

    Returns
    -------
    (n,) complex128
        Equal to ``w`` at held vertices. Others are moved on the way, to smooth the map, as far as no triangle
        is inverted by it.
    """
    w = w.copy()
    for number in reversed(range(len(coarsening.rounds))):
        for vertices, rings in coarsening.rounds[number]:
            still_at_it()
            w[vertices] = places(w[rings])
        if number in coarsening.levels:
            _smooth(w, coarsening.levels[number], held)
    return w


def places(ring: ComplexArray) -> ComplexArray:
    """Where to put a vertex into each ring; (r,) from (r, d), the apex first."""
    place = ring.mean(axis=1)
    poor = np.flatnonzero(~(_shape(place, ring) < _GOOD * ring.shape[1]))
    if poor.size:
        candidates = _candidates(ring[poor], place[poor])
        best = _shape(candidates, ring[poor]).argmin(axis=0)
        place[poor] = np.take_along_axis(candidates, best[None], axis=0)[0]
    return place


def _candidates(ring: ComplexArray, middle: ComplexArray) -> ComplexArray:
    """Places that rings may be seen from; (c, r)."""
    apex = ring[:, 0]
    arm = ring[:, 1:] - apex[:, None]
    left, right = arm[:, 1:], arm[:, :-1]
    # A fan of positive triangles turns from the first arm to the last; half that turn leads inwards.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        turn = np.angle(left * right.conj()).sum(axis=1)
        inwards = arm[:, 0] / np.abs(arm[:, 0]) * np.exp(0.5j * turn)
        room = ((right.conj() * left).imag / np.abs(left - right)).min(axis=1)
        return apex + np.concatenate([np.outer(_TOWARDS_MIDDLE, middle - apex), np.outer(_INWARDS, room * inwards)])


def _shape(place: ComplexArray, ring: ComplexArray) -> FloatArray:
    """Squared sides over twice the area, summed over the triangles around each vertex; infinite if one is inverted.

    Parameters
    ----------
    place : (r,) or (c, r) complex128
    ring : (r, d) complex128
    """
    total = np.zeros(place.shape)
    # Column by column: rows are too short for NumPy to be quick along them.
    spokes = [column - place for column in ring.T]
    squares = [spoke.real**2 + spoke.imag**2 for spoke in spokes]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i, spoke in enumerate(spokes):
            # |a|² + |b|² + |b − a|² = 2 (|a|² + |b|² − Re āb), and the area is half of Im āb.
            product = spokes[i - 1].conj() * spoke
            shape = 2 * (squares[i - 1] + squares[i] - product.real)
            shape /= product.imag
            shape[~(product.imag > 0)] = np.inf
            total += shape
    return total


def _smooth(w: ComplexArray, T: IntArray, held: BoolArray) -> None:
    """Move every vertex towards the middle of its neighbours, and those back that invert a triangle; in place."""
    tail, head = T.ravel(), np.roll(T, -1, axis=1).ravel()
    # Of an interior vertex every neighbour is once the head of a half-edge.
    degree = np.bincount(tail, minlength=w.size)
    moving = np.flatnonzero((degree > 0) & ~held)
    for _ in range(_SWEEPS):
        real, imag = (np.bincount(tail, part.take(head), w.size)[moving] for part in (w.real, w.imag))
        new = w.copy()
        new[moving] += _SHARE * ((real + 1j * imag) / degree[moving] - w[moving])
        back = np.zeros(w.size, dtype=bool)
        inverted = T.compress(~positive(new, T), axis=0)
        while len(inverted) and not back[inverted].all():
            back[inverted] = True
            new[inverted] = w[inverted]
            touched = T.compress(touching(T, back), axis=0)
            inverted = touched.compress(~positive(new, touched), axis=0)
        w[:] = new


def positive(w: ComplexArray, T: IntArray) -> BoolArray:
    """Whether triangles (t, 3) of a map are positive, in floating point; (t,) bool."""
    corners = w.take(T)
    positive: BoolArray = ((corners[:, 1] - corners[:, 0]).conj() * (corners[:, 2] - corners[:, 0])).imag > 0
    return positive
