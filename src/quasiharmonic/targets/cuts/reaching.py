"""Extension of cuts to places where they reduce distortion, balanced against their length.

The minimised *price* is the energy of the map after cutting, as estimated by `Shrinking`, plus a cost per unit length
of cut. A loose end in the interior counts as extra length, to avoid many short cuts, which are laborious to sew.

A cut is made first and then evaluated. The scale is largest at the tip of a limb. A cut from the existing cuts to this
tip is kept if the price decreases. (Gu, Gortler and Hoppe [1]_ cut to where a map stretches most, whatever the cost.)
Then stretches are exchanged for shorter ones as long as the price decreases. Each of these two steps can enable the
other, so they are repeated.

References
----------
.. [1] X. Gu, S. Gortler, H. Hoppe, Geometry images. ACM Trans. Graph. 21 (2002).
.. [2] B. Springborn, P. Schröder, U. Pinkall, Conformal equivalence of triangle meshes. ACM Trans. Graph. 27 (2008).
.. [3] R. Sawhney, K. Crane, Boundary first flattening. ACM Trans. Graph. 37 (2017).
.. [4] N. Sharp, K. Crane, Variational surface cutting. ACM Trans. Graph. 37 (2018).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.linsolve import make_solver
from quasiharmonic.targets.cuts.graph import EdgeGraph
from quasiharmonic.targets.cuts.shortening import shorten_cuts
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray
from quasiharmonic.util.progress import heartbeat

_ROUNDS = 2
# Lower bound of angles in radians, so that cotangents of slivers stay finite.
_LEAST_ANGLE = 1e-3


def extend_cuts(graph: EdgeGraph, cut: BoolArray, min_gain: float) -> BoolArray:
    """Extend cuts to protruding parts as far as the gain justifies their length, and shorten them.

    Parameters
    ----------
    graph : EdgeGraph
        Of a connected surface.
    cut : (e,) bool
        Cut edges that make the surface a disk.
    min_gain : float
        Cost of a unit of length, in units of the mean energy; the surface has area 1.

    Returns
    -------
    (e,) bool
        Cut edges that make the surface a disk.
    """
    balance = _Balance(graph, min_gain)
    if not balance.shrinking.area.any():
        return cut
    for _ in range(_ROUNDS):
        tried = shorten_cuts(graph, balance.extend(cut), balance.price)
        if not balance.price(tried) < balance.price(cut):
            break
        cut = tried
    return cut


class _Balance:
    """Price of cuts: energy plus weighted length."""

    # A loose end costs as much as a cut of this length, in units in which the surface has area 1.
    _END = 0.1
    # The search stops after this many successive tips whose cuts do not lower the price.
    _MAX_FAILURES = 6
    # After a failure, it skips vertices closer to the tip than this share of the distance of the tip from the cuts.
    _NEAR = 0.5
    # Smaller changes of scale need no cut.
    _EVEN = 1e-3
    # Vertices whose scale is within this share of the largest count as equal.
    _TIES = 1e-6

    def __init__(self, graph: EdgeGraph, min_gain: float) -> None:
        self.graph = graph
        self.min_gain = min_gain
        self.shrinking = Shrinking(graph)
        self._rim = graph.rim_vertices
        self._prices: dict[bytes, float] = {}

    def price(self, cut: BoolArray) -> float:
        """Price of cuts: their weighted length plus the estimated energy of the map."""
        key = np.packbits(cut).tobytes()
        if key not in self._prices:
            self._weigh(cut)
        return self._prices[key]

    def _weigh(self, cut: BoolArray) -> FloatArray:
        """Return the scale w under given cuts, and store their price."""
        heartbeat()
        w = self.shrinking.of(self._rim | self.graph.mark_vertices(cut))
        length = float(self.graph.length[cut].sum()) + self._END * int(self._mark_loose_ends(cut).sum())
        self._prices[np.packbits(cut).tobytes()] = self.shrinking.energy(w) + self.min_gain * length
        return w

    def _mark_loose_ends(self, cut: BoolArray) -> BoolArray:
        """Mask (n,) of the vertices that are loose ends of cuts."""
        return (np.bincount(self.graph.ends[cut].ravel(), minlength=self.graph.n) == 1) & ~self._rim

    def extend(self, cut: BoolArray) -> BoolArray:
        """Extend cuts to the vertices with the largest scale, while that lowers the price."""
        w = self._weigh(cut)
        given_up = np.zeros(self.graph.n, dtype=bool)
        distance, before = self._reach(cut)
        failures = 0
        while failures < self._MAX_FAILURES:
            height = np.where(given_up, 0.0, np.abs(w))
            if not height.max() > self._EVEN:
                break
            # The first of the vertices that are equal up to rounding.
            tip = int(np.argmax(height >= (1 - self._TIES) * height.max()))
            longer = cut.copy()
            longer[self.graph.way_back(before, tip)] = True
            w_then = self._weigh(longer)
            if self.price(longer) < self.price(cut):
                cut, w, failures = longer, w_then, 0
                distance, before = self._reach(cut)
            else:
                around, _ = self.graph.distances(np.array([tip]), self.graph.cost, limit=self._NEAR * distance[tip])
                given_up |= np.isfinite(around)
                failures += 1
        return cut

    def _reach(self, cut: BoolArray) -> tuple[FloatArray, IntArray]:
        """Cost of the cheapest path to each vertex from the boundary or a cut, and its predecessor on the path."""
        opened = np.flatnonzero(self._rim | self.graph.mark_vertices(cut))
        return self.graph.distances(opened, self.graph.cost)


class Shrinking:
    """Scales of conformal maps of a surface under different cuts, to estimate how much a map must shrink or stretch.

    A conformal map multiplies lengths by e⁻ʷ. It flattens the surface where Δw = -K with the curvature K. Of all these
    maps, the one that keeps lengths at the boundary, w = 0 there, has the smallest variation of scale (Springborn,
    Schröder and Pinkall [2]_; Sawhney and Crane [3]_). Cuts become boundary, so w = 0 on them. Their effect is computed
    by one linear system with one unknown per vertex of the uncut surface. Its sparsity pattern does not depend on the
    cuts. w is large on protruding parts, such as an arm or an ear, that no cut reaches. It grows with the ratio of
    their length to their width. Sharp and Crane [4]_ let cuts follow the gradient of a similar energy; here it is used
    to evaluate paths.

    Parameters
    ----------
    graph : EdgeGraph
    """

    def __init__(self, graph: EdgeGraph) -> None:
        self.graph = graph
        angles = _angles(graph)
        corner = graph.F.T.ravel()
        self.curvature = 2 * np.pi - np.bincount(corner, angles.ravel(), minlength=graph.n)
        sides = graph.V[graph.F[:, (1, 2, 0)]] - graph.V[graph.F]
        third = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 6
        self.area = np.bincount(corner, np.tile(third, 3), minlength=graph.n)
        # The angle opposite side k is at corner k + 2.
        cotangent = 0.5 / np.tan(angles[(2, 0, 1), :])
        self._stiffness = np.bincount(graph.side.ravel(), cotangent.ravel(), minlength=len(graph.ends))
        self._total = np.bincount(graph.ends.T.ravel(), np.tile(self._stiffness, 2), minlength=graph.n)
        # A row of the upper triangle is its diagonal entry followed by the edges to larger vertices.
        n, e = graph.n, len(graph.ends)
        indptr = np.arange(n + 1) + np.append(0, np.cumsum(np.bincount(graph.ends[:, 0], minlength=n)))
        self._diagonal, self._above = indptr[:-1], np.arange(e) + graph.ends[:, 0] + 1
        indices = np.empty(n + e, dtype=np.int32)
        indices[self._diagonal], indices[self._above] = np.arange(n), graph.ends[:, 1]
        # The stiffness of a triangle whose angles have the sum π is positive semidefinite.
        self._solver = make_solver(indptr, indices, semidefinite=True)

    def of(self, open_at: BoolArray) -> FloatArray:
        """Logarithm w of the factor by which the map shrinks lengths.

        Parameters
        ----------
        open_at : (n,) bool
            Vertices on cuts or on the boundary; at least one.

        Returns
        -------
        (n,) float64
            0 on cuts.
        """
        tail, head = self.graph.ends.T
        values = np.zeros(self.graph.n + len(self.graph.ends))
        between = ~(open_at[tail] | open_at[head])
        values[self._above[between]] = -self._stiffness[between]
        values[self._diagonal] = np.where(open_at, 1.0, self._total)
        self._solver.factor(values)
        return self._solver.solve(np.where(open_at, 0.0, self.curvature))

    def energy(self, w: FloatArray) -> float:
        """Estimate the lowest mean symmetric Dirichlet energy of a map.

        Let x = |w - c| with the median c of w. Where x is small, the map is nearly conformal, with energy
        ``2 e²ˣ + 2 e⁻²ˣ - 4 ≈ 8 x²``. Unlike a conformal map, a map of least energy does not shrink long protrusions to
        almost nothing but keeps their area. A tube of radius r becomes a ring of radius R with R R' = r. Its energy (R
        / r)² + (r / R)² grows with the tube's length over r, and so with x.
        """
        order = np.argsort(w, kind="stable")
        below = np.cumsum(self.area[order])
        median = w[order[np.searchsorted(below, 0.5 * below[-1])]]
        x = np.abs(w - median)
        return float((self.area * 8 * x * x / (1 + 2 * x)).sum() / below[-1])


def _angles(graph: EdgeGraph) -> FloatArray:
    """Angles at the corners of all triangles, (3, f), bounded below and with sum π in each triangle."""
    sides = np.stack([graph.V[graph.F[:, (k + 1) % 3]] - graph.V[graph.F[:, k]] for k in range(3)])
    back = -sides[(2, 0, 1), :]
    sine = np.linalg.norm(np.cross(sides, back), axis=2)
    angles = np.maximum(np.arctan2(sine, (sides * back).sum(axis=2) + 0.0), _LEAST_ANGLE)
    return np.asarray(angles * (np.pi / angles.sum(axis=0)))
