"""A tetrahedral mesh that follows its boundary in steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.tetrahedra.certificate import space_array
from quasiharmonic.apps.tetrahedra.descent import TetrahedraDescent
from quasiharmonic.apps.tetrahedra.placement import check_rest, extend_harmonically, make_energy
from quasiharmonic.apps.tetrahedra.signs import tetrahedron_signs
from quasiharmonic.apps.tetrahedra.sliding import find_sliding
from quasiharmonic.apps.tetrahedra.tetrahedral_maps import find_moved, find_still
from quasiharmonic.util.arrays import FloatArray, IntArray

# Maximum number of Newton steps to untangle the mesh after one move.
_MAX_STEPS = 200


class MovingTetrahedra:
    """The part of `quasiharmonic.MovingMesh` for tetrahedra.

    Each move adds the harmonic extension of the displacement. If tetrahedra are then inverted, they are untangled.
    ``settle`` Newton steps lower the isotropic energy relative to the first mesh. ``slide`` as in `find_sliding`; it
    refers to the first mesh.
    """

    def __init__(
        self, points: ArrayLike, T: ArrayLike, moved_vertices: ArrayLike, settle: int, slide: bool | ArrayLike = False
    ) -> None:
        self.points = space_array("points", points)
        self._mesh = check_rest(T, self.points)
        self._settle = settle
        self._moved = find_moved(self._mesh, len(self.points), moved_vertices)
        sliding = find_sliding(self._mesh.faces.boundary, self.points, self._moved, slide)
        self._fixed = np.concatenate([self._moved, find_still(self._mesh, self._moved, sliding)])
        self._free = np.setdiff1d(np.unique(self._mesh.T), self._fixed)
        self._projections = sliding.restrict(self._free)
        self._energy, scaled, self._exponent = make_energy(self._mesh, self.points, False)
        self._descent = TetrahedraDescent(self._energy, self._free, scaled, projections=self._projections)

    @property
    def T(self) -> IntArray:
        """The tetrahedra (t, 4), positive at rest."""
        return self._mesh.T

    def advance(self, target: ArrayLike) -> FloatArray:
        """Move the boundary; return the new mesh, or raise a RuntimeError and leave the mesh unchanged."""
        goal = space_array("target", target, self._moved.size)
        descent = self._descent
        before = np.zeros_like(self.points)
        used = np.unique(self._mesh.T)
        before[used] = np.ldexp(self.points[used], -self._exponent)
        places = before[self._fixed]
        places[: self._moved.size] = np.ldexp(goal, -self._exponent)
        with np.errstate(all="ignore"):
            descent.X = extend_harmonically(self._energy, before, self._fixed, places, self._projections)
            descent.X[self._fixed] = places
            if descent.make_valid(_MAX_STEPS):
                for _ in descent.polish(self._settle, 1e-8):
                    pass
        points = self.points.copy()
        points[self._moved] = goal
        points[self._free] = np.ldexp(descent.X[self._free], self._exponent)
        bad = np.flatnonzero(tetrahedron_signs(self._mesh.T, points)[0] <= 0)
        if bad.size:
            raise RuntimeError(
                f"{bad.size} tetrahedra, the first of them {bad[0]}, stay inverted after this step; use shorter steps, "
                "or a new mesh"
            )
        self.points = points
        return points.copy()
