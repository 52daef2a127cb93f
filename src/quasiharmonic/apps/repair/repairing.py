"""Repair of a map with inverted triangles: its boundary stays, and as much of its interior as can.

A map comes apart into islands at its seams, and each is repaired on its own (`IslandRepair`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas.verdict import mirrored_islands
from quasiharmonic.apps.repair.island_repair import IslandRepair
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh, which_island
from quasiharmonic.io.adapters.accepts_mesh import accepts_mesh
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import Step
from quasiharmonic.util.arrays import FloatArray, IntArray, check_callback, counted, named, true_or_false, whole_number
from quasiharmonic.util.progress import reports_progress


@dataclass(frozen=True, eq=False)
class RepairedIsland:
    """What became of an island; numbers are the mesh's, from 0.

    Attributes
    ----------
    triangles : (k,) int64
        Its triangles, ascending.
    inverted_before, inverted : (a,), (b,) int64
        Those that were not strictly positive, and those that are still not.
    moved_vertices : (c,) int64
        Vertices that are in another place than before.
    mirrored : bool
        Whether every triangle was strictly negative, as in an island that was turned over on purpose, one of several.
        It then was left, unless asked for, and is judged as the other side shows it.
    bijective : bool
        Whether the island, as it now is, covers no place twice. What its boundary overlaps stays so.
    reason : str
        Why triangles are still inverted; empty where none is.
    diagnosis : Diagnosis or None
        What forbids a map with this boundary, examined where triangles are still inverted.
    """

    triangles: IntArray
    inverted_before: IntArray
    inverted: IntArray
    moved_vertices: IntArray
    mirrored: bool
    bijective: bool
    reason: str = ""
    diagnosis: Diagnosis | None = None

    @property
    def injective(self) -> bool:
        """Whether every triangle is strictly positive."""
        return not self.inverted.size

    def summary(self) -> str:
        """Say in a sentence what was done."""
        where = which_island(self.triangles)
        overlap = "" if self.bijective or not self.injective else "; it overlaps itself"
        if self.mirrored:
            done = "turned over" if self.moved_vertices.size else "mirrored, left unchanged"
            return f"{where}: {done}{overlap}"
        if not self.inverted_before.size:
            return f"{where}: nothing to repair{overlap}"
        done = (
            f"{len(self.inverted_before)} inverted before, {len(self.inverted)} now; "
            f"{counted('vertex', 'vertices', len(self.moved_vertices))} moved"
        )
        left = f"; {named('triangle', 'triangles', self.inverted)} left. {self.reason}" if self.inverted.size else ""
        return f"{where}: {done}{overlap}{left}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON; of the triangles, the first and how many there are."""
        return {
            "first_triangle": int(self.triangles[0]),
            "triangles": len(self.triangles),
            "mirrored": self.mirrored,
            "injective": self.injective,
            "bijective": self.bijective,
            "inverted_before": self.inverted_before.tolist(),
            "inverted": self.inverted.tolist(),
            "moved_vertices": self.moved_vertices.tolist(),
            "reason": self.reason,
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_dict(),
        }


@dataclass(frozen=True, eq=False)
class RepairResult:
    """A repaired map.

    Attributes
    ----------
    uv : (m, 2) float64
        Places. Those that no vertex moved from are as they were, to the last bit.
    FT : (f, 3) int64
        For every corner the row of ``uv`` it is at: as given, unless a vertex moved from a row that others use.
        Then it has a new row at the end.
    islands : tuple of RepairedIsland
        By their first triangle.
    """

    uv: FloatArray
    FT: IntArray
    islands: tuple[RepairedIsland, ...]

    @property
    def injective(self) -> bool:
        """Whether every triangle that has a place is strictly positive, and there is one."""
        return bool(self.islands) and all(island.injective for island in self.islands)

    @property
    def moved_vertices(self) -> IntArray:
        """Vertices of the mesh that are in another place than before, ascending."""
        return np.unique(
            np.concatenate([np.empty(0, dtype=np.int64), *(island.moved_vertices for island in self.islands)])
        )

    def summary(self) -> str:
        """What was done, in all and for each island that needed it."""
        before, now = (sum(len(getattr(i, name)) for i in self.islands) for name in ("inverted_before", "inverted"))
        lines = [
            f"{counted('island', 'islands', len(self.islands))}: "
            f"{counted('triangle', 'triangles', before)} inverted before, {now} now; "
            f"{counted('vertex', 'vertices', len(self.moved_vertices))} moved"
        ]
        return "\n".join(lines + [f"- {i.summary()}" for i in self.islands if i.inverted_before.size or i.mirrored])

    def to_dict(self) -> dict[str, Any]:
        """For JSON: everything but the map itself."""
        return {
            "injective": self.injective,
            "inverted_before": sum(len(island.inverted_before) for island in self.islands),
            "inverted": sum(len(island.inverted) for island in self.islands),
            "moved_vertices": len(self.moved_vertices),
            "islands": [island.to_dict() for island in self.islands],
        }


@accepts_mesh
@reports_progress
def repair(
    V: ArrayLike,
    F: ArrayLike,
    uv: ArrayLike,
    *,
    FT: ArrayLike | None = None,
    whole: bool = False,
    unmirror: bool = False,
    max_iterations: int = 2000,
    linear_solver: str = "auto",
    callback: Callable[[Step], object] | None = None,
) -> RepairResult:
    """Right the inverted triangles of a map; the boundary stays, and as much of the interior as can.

    Around inverted triangles, patches of growing size are mapped anew with their boundary held. Of a patch that
    comes out with all triangles positive, vertices return to where they were as far as that inverts nothing, and the
    others go where the distortion (symmetric Dirichlet) is least. What a patch cannot do the whole island may.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        The surface.
    F : (f, 3) array of int
        Triangles.
    uv : (m, 2) array
        The map: places. Interior vertices may be anywhere, even at NaN.
    FT : (f, 3) array of int, optional
        For a map with seams, the row of ``uv`` that each corner is at; a triangle with a corner at -1 has no place
        and is left alone. By default ``F``. See `quasiharmonic.geometry.mesh.seams.SeamedMesh` for what counts as a
        seam.
    whole : bool
        Map every island that has inverted triangles anew as a whole, and polish it.
    unmirror : bool
        Turn islands over that are mirrored, each in its place. Otherwise they are left as they are: of several islands
        some often are, on purpose, to use a picture twice.
    max_iterations : int
        Linear solves to spend at most on an island as a whole.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration, and with the last one again at least every half second in between, but
        not within a single factorisation.

    Returns
    -------
    RepairResult
        With the map and, island by island, what changed, certified exactly; and why, where triangles are still
        inverted: that is no exception.

    Raises
    ------
    ValueError
        When an array has the wrong shape or dtype, or indices that refer to nothing.
    KeyboardInterrupt
        By Ctrl-C.

    Examples
    --------
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> uv = V.copy()
    >>> uv[0] = [0.4, 0.1]
    >>> result = repair(V, F, uv)
    >>> len(result.islands[0].inverted_before), result.injective, result.moved_vertices.tolist()
    (2, True, [0])
    """
    whole_number("max_iterations", max_iterations, least=1)
    true_or_false("whole", whole)
    true_or_false("unmirror", unmirror)
    check_callback(callback)
    mesh = SeamedMesh(V, F, FT, uv)
    done = []
    for island, mirrored in zip(mesh.islands, mirrored_islands(mesh), strict=True):
        if mirrored:
            done.append(_mirrored(island, unmirror))
            continue
        one = IslandRepair(
            mesh.V, island, max_iterations=max_iterations, linear_solver=linear_solver, callback=callback
        )
        before = island.triangles[one.inverted]
        if before.size:
            one.run(whole)
        certificate = certify(island.F, one.uv)
        done.append(
            (
                one.uv,
                RepairedIsland(
                    triangles=island.triangles,
                    inverted_before=before,
                    inverted=island.triangles[one.inverted],
                    moved_vertices=np.unique(island.vertices[one.moved_mask]),
                    mirrored=False,
                    bijective=bool(certificate.bijective),
                    reason="" if certificate.injective else one.reason,
                    diagnosis=None if certificate.injective else one.diagnosis,
                ),
            )
        )
    mended = mesh.with_places([new for new, _ in done])
    assert mended.uv is not None
    return RepairResult(mended.uv, mended.FT, tuple(report for _, report in done))


def _mirrored(island: Island, turn: bool) -> tuple[FloatArray, RepairedIsland]:
    """A mirrored island, turned over within its box if asked for."""
    uv = island.uv.copy()
    if turn:
        uv[:, 0] = uv[:, 0].min() + uv[:, 0].max() - uv[:, 0]
    certificate = certify(island.F if turn else island.F[:, ::-1], uv)
    wrong = np.sort(np.concatenate([certificate.inverted, certificate.degenerate]))
    none = np.empty(0, dtype=np.int64)
    return uv, RepairedIsland(
        triangles=island.triangles,
        inverted_before=none,
        inverted=island.triangles[wrong],
        moved_vertices=np.unique(island.vertices) if turn else none,
        mirrored=True,
        bijective=bool(certificate.bijective),
        reason="Double precision cannot express it the other way around." if wrong.size else "",
    )
