"""Estimate how much a cut surface must shrink or stretch to be flattened, without flattening it.

A conformal map multiplies lengths by e⁻ʷ. It flattens the surface where Δw = -K with the curvature K. Of all these
maps, the one that keeps lengths at the boundary, w = 0 there, has the smallest variation of scale (Springborn, Schröder
and Pinkall [1]_; Sawhney and Crane [2]_). Cuts become boundary, so w = 0 on them. Their effect is computed by one
linear system with one unknown per vertex of the uncut surface. Its sparsity pattern does not depend on the cuts. w is
large on protruding parts, such as an arm or an ear, that no cut reaches. It grows with the ratio of their length to
their width. Sharp and Crane [3]_ let cuts follow the gradient of a similar energy; here it is used to evaluate paths.

References
----------
.. [1] B. Springborn, P. Schröder, U. Pinkall, Conformal equivalence of triangle meshes. ACM Trans. Graph. 27 (2008).
.. [2] R. Sawhney, K. Crane, Boundary first flattening. ACM Trans. Graph. 37 (2017).
.. [3] N. Sharp, K. Crane, Variational surface cutting. ACM Trans. Graph. 37 (2018).
"""

from __future__ import annotations

import numpy as np

from quasiharmonic.linsolve import make_solver
from quasiharmonic.targets.cuts.graph import EdgeGraph
from quasiharmonic.util.arrays import BoolArray, FloatArray

# Lower bound of angles in radians, so that cotangents of slivers stay finite.
_LEAST_ANGLE = 1e-3


class Shrinking:
    """Scales of conformal maps of a surface under different cuts.

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
        # A row of the upper triangle is its diagonal entry followed by the edges to larger vertices.
        n, e = graph.n, len(graph.ends)
        indptr = np.arange(n + 1) + np.append(0, np.cumsum(np.bincount(graph.ends[:, 0], minlength=n)))
        self._diagonal, self._above = indptr[:-1], np.arange(e) + graph.ends[:, 0] + 1
        indices = np.empty(n + e, dtype=np.int32)
        indices[self._diagonal], indices[self._above] = np.arange(n), graph.ends[:, 1]
        self._solver = make_solver(indptr, indices)

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
        total = np.bincount(np.concatenate([tail, head]), np.tile(self._stiffness, 2), minlength=self.graph.n)
        values[self._diagonal] = np.where(open_at, 1.0, total)
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
