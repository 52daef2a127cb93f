"""Repair a map with inverted triangles: keep its boundary and as much of its interior as possible.

Seams split a map into islands. `IslandRepair` repairs each island separately.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.atlas import atlas_verdict
from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict, IslandReport, is_mirrored, mirrored_islands
from quasiharmonic.apps.island_repair import IslandRepair
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh, which_island
from quasiharmonic.problem.diagnosis import Diagnosis
from quasiharmonic.problem.result import Status, Step
from quasiharmonic.util.arrays import FloatArray, IntArray, count_of, names_of, vertex_indices
from quasiharmonic.util.options import RepairOptions, takes
from quasiharmonic.util.outcome import SummarisedOutcome, as_plain
from quasiharmonic.util.progress import reports_progress


@dataclass(frozen=True, eq=False)
class RepairedIsland(IslandReport):
    """The repair report of one island; indices are the mesh's, from 0.

    Attributes
    ----------
    triangles : (k,) int64
        Triangles of the island, ascending.
    inverted_before, inverted : (a,), (b,) int64
        Triangles that were not strictly positive before the repair, and those that still are not.
    moved_vertices : (c,) int64
        Vertices whose position changed.
    mirrored : bool
        Whether every triangle was strictly negative. In a map of several islands this is often intended. The island
        is left unchanged unless ``unmirror`` is set, and is certified as its reflection.
    bijective : bool
        Whether the repaired island is bijective. Overlaps of its fixed boundary remain.
    reason : str
        Why triangles are still inverted; empty if there are none.
    diagnosis : Diagnosis or None
        The obstruction to a map with this boundary, computed if triangles are still inverted.
    n_iterations : int
        Iterations of all searches and descents.

    See Also
    --------
    RepairResult : Lists them as ``islands``.

    Examples
    --------
    >>> from quasiharmonic import repair
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> uv = V.copy()
    >>> uv[0] = [0.4, 0.1]
    >>> (island,) = repair(V, F, uv).islands
    >>> len(island.inverted_before), len(island.inverted), island.moved_vertices.tolist()
    (2, 0, [0])
    """

    inverted_before: IntArray
    inverted: IntArray
    moved_vertices: IntArray
    bijective: bool
    reason: str = ""
    diagnosis: Diagnosis | None = None
    n_iterations: int = 0

    @property
    def injective(self) -> bool:
        """Whether every triangle is strictly positive."""
        return not self.inverted.size

    def summary(self) -> str:
        """Describe the repair in one line."""
        where = which_island(self.triangles)
        overlap = "" if self.bijective or not self.injective else "; it overlaps itself"
        if self.mirrored:
            done = "turned over" if self.moved_vertices.size else "mirrored, left unchanged"
            return f"{where}: {done}{overlap}"
        if not self.inverted_before.size:
            return f"{where}: nothing to repair{overlap}"
        done = (
            f"{len(self.inverted_before)} inverted before, {len(self.inverted)} now; "
            f"{count_of('vertex', 'vertices', len(self.moved_vertices))} moved"
        )
        left = f"; {names_of('triangle', 'triangles', self.inverted)} left. {self.reason}" if self.inverted.size else ""
        return f"{where}: {done}{overlap}{left}"

    def to_dict(self) -> dict[str, Any]:
        """The report for JSON, with the first triangle and the number of triangles."""
        verdict = "injective", "bijective", "inverted_before", "inverted"
        return super().to_dict() | as_plain(self, *verdict, "moved_vertices", "reason", "diagnosis")


@dataclass(frozen=True, eq=False, repr=False)
class RepairResult(SummarisedOutcome):
    """A repaired map with a report for every island.

    Attributes
    ----------
    uv : (m, 2) float64
        Vertex positions. Positions of vertices that did not move are bitwise unchanged.
    FT : (f, 3) int64
        For every corner its row of ``uv``. If a moved vertex shared its row with other vertices, it has a new row at
        the end.
    islands : tuple of RepairedIsland
        Reports, in the order of each island's first triangle.
    mesh : SeamedMesh
        The surface with its new positions.
    seconds : float

    See Also
    --------
    repair : Makes it.
    results.RepairedIsland : The report of an island.

    Examples
    --------
    >>> from quasiharmonic import repair
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> repaired = repair(V, F, V)
    >>> repaired.success, len(repaired.islands), len(repaired.moved_vertices)
    (True, 1, 0)
    """

    uv: FloatArray
    FT: IntArray
    islands: tuple[RepairedIsland, ...]
    mesh: SeamedMesh
    seconds: float

    @property
    def status(self) -> Status:
        """``INJECTIVE`` if every triangle is positive, otherwise ``STALLED``."""
        return Status.of(self.success)

    @cached_property
    def certificate(self) -> AtlasVerdict:
        """The exact verdict on the new positions."""
        return atlas_verdict.certify(self.mesh)

    @property
    def success(self) -> bool:
        """Whether no triangle is inverted any more; equal to `injective`."""
        return self.injective

    @property
    def injective(self) -> bool:
        """Whether there is an island, and every triangle of every island is strictly positive."""
        return bool(self.islands) and all(island.injective for island in self.islands)

    @property
    def n_iterations(self) -> int:
        """Iterations over all islands."""
        return sum(island.n_iterations for island in self.islands)

    @property
    def moved_vertices(self) -> IntArray:
        """Vertices of the mesh whose position changed, ascending."""
        return np.unique(
            np.concatenate([np.empty(0, dtype=np.int64), *(island.moved_vertices for island in self.islands)])
        )

    def summary(self) -> str:
        """Describe the repair, in total and for every island that needed it."""
        before, now = self._count_inverted()
        lines = [
            f"{count_of('island', 'islands', len(self.islands))}: "
            f"{count_of('triangle', 'triangles', before)} inverted before, {now} now; "
            f"{count_of('vertex', 'vertices', len(self.moved_vertices))} moved"
        ]
        if now:
            lines[0] += "; move the boundary of the islands listed, or flatten these islands again"
        return "\n".join(lines + [f"- {i.summary()}" for i in self.islands if i.inverted_before.size or i.mirrored])

    def _count_inverted(self) -> tuple[int, int]:
        """Numbers of inverted triangles before and after the repair."""
        return sum(len(i.inverted_before) for i in self.islands), sum(len(i.inverted) for i in self.islands)

    def to_dict(self) -> dict[str, Any]:
        """The report for JSON, without the map."""
        before, now = self._count_inverted()
        return {
            **super().to_dict(),
            "injective": self.injective,
            "inverted_before": before,
            "inverted": now,
            "moved_vertices": len(self.moved_vertices),
            "islands": [island.to_dict() for island in self.islands],
        }


class RepairKeywords(TypedDict, total=False):
    """Types of the options of `repair`."""

    fixed: ArrayLike | None
    whole: bool
    unmirror: bool
    max_iterations: int
    linear_solver: str
    callback: Callable[[Step], object] | None


@accepts_mesh
@reports_progress
@takes(RepairOptions, RepairKeywords)
def repair(
    V: ArrayLike, F: ArrayLike, uv: ArrayLike, *, FT: ArrayLike | None = None, **options: Unpack[RepairKeywords]
) -> RepairResult:
    """Repair the inverted triangles of a map, keeping its boundary and as much of its interior as possible.

    Patches of growing size around inverted triangles are mapped again with their boundaries fixed. In a successful
    patch, vertices return to their old positions where this inverts no triangle. The other vertices minimise the
    symmetric Dirichlet energy. If a patch fails, the whole island is mapped again.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        The surface.
    F : (f, 3) array of int
        Triangles.
    uv : (m, 2) array
        Vertex positions of the map. Interior vertices may have any position, even NaN.
    FT : (f, 3) array of int, optional
        For a map with seams, the row of ``uv`` of each corner; ``F`` by default. Triangles with a corner of -1 have no
        position and are left unchanged. `quasiharmonic.io.seamed_mesh.SeamedMesh` defines seams.
    fixed : (k,) array of int, optional
        Interior vertices that also keep their positions, except in islands that ``unmirror`` reflects.
    whole : bool
        Map every island that has inverted triangles again as a whole, and polish it.
    unmirror : bool
        Reflect mirrored islands in place. By default they are left unchanged, because islands are often mirrored on
        purpose to use an image twice.
    max_iterations : int
        Maximum number of linear solves when an island is mapped as a whole.
    linear_solver : str
        ``"auto"`` or one of `quasiharmonic.linsolve.available`.
    callback : callable, optional
        Called with a `Step` at every iteration. Between iterations it is called again with the last `Step` at least
        every half second, except during a factorisation.

    Returns
    -------
    RepairResult
        The map and, for every island, the changes and the certified result. If triangles are still inverted, it
        reports the reason and raises no exception.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype, or indices are out of range.
    KeyboardInterrupt
        By Ctrl-C.

    See Also
    --------
    injective_map : Maps the surface again.
    inverted_triangles : Lists inverted triangles.
    polish : Lowers the distortion afterwards.

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
    began = time.perf_counter()
    checked = RepairOptions(**options)
    mesh = SeamedMesh(V, F, FT, uv)
    fixed = vertex_indices("fixed", () if checked.fixed is None else checked.fixed, len(mesh.V))
    # A single mirrored island is called inverted, unless it is to be reflected.
    mirrored = [is_mirrored(one.F, one.uv) for one in mesh.islands] if checked.unmirror else mirrored_islands(mesh)
    done = [
        _report_mirrored(island, checked.unmirror) if turned else _repair_island(mesh.V, island, fixed, checked)
        for island, turned in zip(mesh.islands, mirrored, strict=True)
    ]
    repaired = mesh.with_places([new for new, _ in done])
    assert repaired.uv is not None
    seconds = time.perf_counter() - began
    return RepairResult(repaired.uv, repaired.FT, tuple(report for _, report in done), repaired, seconds)


def _repair_island(
    V: FloatArray, island: Island, fixed: IntArray, options: RepairOptions
) -> tuple[FloatArray, RepairedIsland]:
    """Repair an island that is not mirrored; return its new positions and the report."""
    one = IslandRepair(V, island, fixed, options)
    before = island.triangles[one.inverted]
    if before.size:
        one.run()
    certificate = certify(island.F, one.uv)
    return one.uv, RepairedIsland(
        triangles=island.triangles,
        inverted_before=before,
        inverted=island.triangles[one.inverted],
        moved_vertices=np.unique(island.vertices[one.moved_mask]),
        mirrored=False,
        bijective=bool(certificate.bijective),
        reason="" if certificate.injective else one.reason,
        diagnosis=None if certificate.injective else one.diagnosis,
        n_iterations=one.n_iterations,
    )


def _report_mirrored(island: Island, turn: bool) -> tuple[FloatArray, RepairedIsland]:
    """Report a mirrored island, reflected within its bounding box if ``turn``."""
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
        reason="Double precision cannot express its reflection. Move the map nearer to the origin."
        if wrong.size
        else "",
    )
