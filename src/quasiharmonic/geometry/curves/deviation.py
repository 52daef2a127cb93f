"""Barrier on the deviation of boundary edges from the curves along which their ends slide.

Sliding vertices tend to leave a bend if it costs energy. The edge across the bend then cuts it off, and the
boundary polygon no longer follows the outline. So the deviation of every edge from its section of the curve is bounded.
The bound is 1.2 times the largest initial deviation, or that after all vertices have moved halfway to the next one,
whichever is larger. With K points of the section at distances dₖ from the edge's line,

    m = Σₖ dₖ² / K        barrier = −log(1 − m/M) − m/M        with M the bound,

which is negligible unless m is close to M. Second derivatives are Gauss-Newton approximations, positive semidefinite.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quasiharmonic.geometry.curves.boundary_curves import Chain, Track
from quasiharmonic.util.arrays import FloatArray, IntArray

# Sample points on a section, as fractions of its length.
_FRACTIONS = np.arange(1, 8) / 8


class DeviationBarrier:
    """Barrier of all edges between neighbours on a curve, as a function of the lengths of the sliding vertices.

    Parameters
    ----------
    track : Track
    loops : sequence of (l,) int64
        Boundary loops.
    exactly : bool
        Evaluate curves exactly at the given lengths instead of by a fast interpolation. Gradients are then
        the derivatives of values up to rounding.

    Attributes
    ----------
    pairs : (e, 2) int64
        Sliding vertices at the ends of the edges, as indices into ``track.vertices``; -1 for a fixed vertex.
    """

    def __init__(self, track: Track, loops: Sequence[IntArray], *, exactly: bool = False) -> None:
        # Squared deviations below this fraction of the squared size of the curve are rounding: the curve is straight.
        straight = 1e-18
        # Maximum deviation of an edge relative to the largest initial deviation.
        max_growth = 1.2
        following = {int(i): int(j) for loop in loops for i, j in zip(loop, np.roll(loop, -1), strict=True)}
        number = {int(v): k for k, v in enumerate(track.vertices)}
        self._track, self._exactly = track, exactly
        self._edges: list[tuple[int, IntArray, IntArray]] = []
        self._bounds: list[float] = []
        pairs = []
        for k, chain in enumerate(track.chains):
            ahead = np.roll(np.arange(chain.s.size), -1)
            tail = np.flatnonzero(
                [
                    following.get(int(i)) == j or following.get(int(j)) == i
                    for i, j in zip(chain.vertices, chain.vertices[ahead], strict=True)
                ]
            )
            if not chain.curve.closed:
                tail = tail[tail < chain.s.size - 1]
            head = ahead[tail]
            bound = max_growth**2 * _max_deviation(chain, tail, head)
            kept = chain.sliding[tail] | chain.sliding[head]
            if bound <= straight * chain.curve.size**2 or not kept.any():
                continue
            self._edges.append((k, tail[kept], head[kept]))
            self._bounds.append(bound)
            ends = np.stack([chain.vertices[tail[kept]], chain.vertices[head[kept]]], axis=1)
            pairs += [[number.get(i, -1), number.get(j, -1)] for i, j in ends.tolist()]
        self.pairs: IntArray = np.array(pairs, dtype=np.int64).reshape(-1, 2)

    def value(self, s: FloatArray) -> float:
        """Mean barrier over the edges; ``inf`` if an edge exceeds its bound."""
        return self.value_of(self.room(s))

    def room(self, s: FloatArray) -> FloatArray:
        """``1 − m/M`` of each edge (e,); not positive for an edge that exceeds its bound."""
        return np.concatenate([np.empty(0), *(1 - share for share, _, _ in self._shares(s))])

    @staticmethod
    def value_of(room: FloatArray) -> float:
        """Mean barrier of edges, given the `room` (e,) of each."""
        if not room.size:
            return 0.0
        return float(np.mean(-np.log(room) - (1 - room))) if (room > 0).all() else np.inf

    def derivatives(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """First (e, 2) and second (e, 2, 2) derivatives of the mean barrier by the lengths at the ends of each edge.

        The second derivatives are made positive semidefinite.
        """
        gradients, hessians = [np.empty((0, 2))], [np.empty((0, 2, 2))]
        for share, by_ends, by_both in self._shares(s):
            first, second = share / (1 - share), 1 / (1 - share) ** 2
            gradients.append(first[:, None] * by_ends)
            hessians.append(
                first[:, None, None] * by_both + second[:, None, None] * by_ends[:, :, None] * by_ends[:, None, :]
            )
        count = max(len(self.pairs), 1)
        return np.concatenate(gradients) / count, np.concatenate(hessians) / count

    def add_at_ends(self, total: FloatArray, values: FloatArray) -> None:
        """Add values (e, 2) at the ends of the edges to the total (k,) of each sliding vertex."""
        for number, value in zip(self.pairs.T, values.T, strict=True):
            np.add.at(total, number[number >= 0], value[number >= 0])

    def _shares(self, s: FloatArray) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        """``m/M`` of the edges on each curve, with first and second derivatives by the lengths of the ends."""
        found, every = [], self._track.all_lengths(s)
        for (k, tail, head), bound in zip(self._edges, self._bounds, strict=True):
            share, by_ends, by_both = _mean_deviation(
                self._track.chains[k], every[k][tail], every[k][head], exactly=self._exactly
            )
            found.append((share / bound, by_ends / bound, by_both / bound))
        return found


def _max_deviation(chain: Chain, tail: IntArray, head: IntArray) -> float:
    """Largest squared deviation of an edge, initially or with sliding vertices halfway to the next."""
    if not tail.size:
        return 0.0
    here, there = chain.s[tail], chain.s[head]
    found = _mean_deviation(chain, here, there)[0].max()
    middle = here + 0.5 * ((there - here) % chain.curve.length)
    # Halfway positions are used only for two consecutive edges with a sliding vertex between them, so that no corner is
    # cut off.
    order = {int(i): k for k, i in enumerate(tail)}
    links = [(order[int(i)], k) for k, i in enumerate(tail) for i in [head[k]] if int(i) in order and chain.sliding[i]]
    if links:
        before, after = (middle[k] % chain.curve.length for k in np.array(links).T[::-1])
        found = max(found, _mean_deviation(chain, before, after)[0].max())
    return float(found)


def _mean_deviation(
    chain: Chain, begin: FloatArray, end: FloatArray, *, exactly: bool = False
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean squared distances between sections (e,) of a curve and their chords, with derivatives by both ends."""
    curve = chain.curve
    gap = (end - begin) % curve.length if curve.closed else end - begin
    shares = np.concatenate([[0.0], _FRACTIONS, [1.0]])
    along = begin[:, None] + gap[:, None] * shares
    points, tangents = curve.sample(along, exactly=exactly)
    side = points[:, -1] - points[:, 0]
    normal = 1j * side / np.abs(side)
    local = (points[:, 1:-1] - points[:, :1]) / side[:, None]
    distance = local.imag * np.abs(side)[:, None]

    def measure_across(vectors: NDArray[np.complex128]) -> FloatArray:
        return np.asarray((vectors * normal.conj()[:, None]).real)

    inner = measure_across(tangents[:, 1:-1])
    by_begin = (1 - _FRACTIONS) * inner - (1 - local.real) * measure_across(tangents[:, :1])
    by_end = _FRACTIONS * inner - local.real * measure_across(tangents[:, -1:])
    by_ends = np.stack([by_begin, by_end], axis=1)
    count = _FRACTIONS.size
    return (
        (distance**2).sum(axis=1) / count,
        2 * (distance[:, None] * by_ends).sum(axis=2) / count,
        2 * by_ends @ by_ends.swapaxes(1, 2) / count,
    )
