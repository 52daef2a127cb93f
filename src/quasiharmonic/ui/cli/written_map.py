"""Exact verdict on the map of a written file, as a reader gets it from the file, for the report of a command.

`certify_map` returns the verdict, a `WrittenMap`. `describe_maps` and `describe_end` also report on the computation.

A face of the file is *bent* if splitting it at its first corner gives inverted triangles in the map; some programs
split faces in this way. A map may be injective although faces are bent, because `read_mesh` may split them differently.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quasiharmonic.util.outcome import as_plain

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict
    from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
    from quasiharmonic.apps.unwrapping.chart_verdict import SetApart
    from quasiharmonic.geometry.exact.certificate import Certificate
    from quasiharmonic.io import MeshData


@dataclass(frozen=True, eq=False)
class WrittenMap:
    """Exact certificate of a file's map."""

    V: NDArray[np.float64]  # (m, 3)
    F: NDArray[np.int64]  # (f, 3); zero for triangles of unmapped faces
    uv: NDArray[np.float64]  # (m, 2): the mesh and its map, cut at seams: one vertex per texture coordinate of a vertex
    certificate: Certificate  # Certificate of the whole map in the plane
    verdict: AtlasVerdict | None  # Certificates of the islands; None for a single island
    faces: int  # Number of faces in the file
    unmapped: NDArray[np.int64]  # Faces without texture coordinates at a corner, which are not verified
    bent: NDArray[np.int64]  # Faces with inverted triangles for a reader that splits faces at their first corner
    set_apart: SetApart | None = None  # Triangles that the verdict reverses or leaves out; None if there are none

    @property
    def injective(self) -> bool:
        """Whether every island is injective, possibly mirrored."""
        return self.certificate.injective if self.verdict is None else self.verdict.injective

    @property
    def bijective(self) -> bool:
        """Whether every island is bijective."""
        return bool(self.certificate.bijective) if self.verdict is None else self.verdict.bijective

    @property
    def apart(self) -> bool:
        """Whether every island is bijective, and no two islands overlap."""
        return self.bijective and (self.verdict is None or not len(self.verdict.overlapping))

    @property
    def mirrored(self) -> bool:
        """Whether an island is mirrored."""
        return self.verdict is not None and bool(self.verdict.mirrored.size)

    @property
    def inverted(self) -> NDArray[np.int64]:
        """Triangles whose orientation differs from that of their island, and degenerate triangles."""
        import numpy as np

        if self.verdict is not None:
            return self.verdict.inverted
        return np.concatenate([self.certificate.inverted, self.certificate.degenerate])

    def summary(self) -> str:
        """Return the verdict in sentences."""
        from quasiharmonic.util.arrays import names_of

        text = self.certificate.summary() if self.verdict is None else self.verdict.summary()
        if self.unmapped.size:
            where = names_of("face", "faces", self.unmapped)
            text += f"\nThe verdict is on the other faces, because there are no texture coordinates on {where}."
        if (faces := self.faces - len(self.unmapped)) < self.certificate.triangles:
            text += f"\nThe verdict is on the {self.certificate.triangles} triangles that stand for its {faces} faces."
        if self.bent.size:
            text += f"\n{describe_bent(self.bent)}"
        return text if self.set_apart is None else f"{text}\n{self.set_apart.summary()}"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as the first entries of the JSON report."""
        apart = {} if self.verdict is None else {k: self.verdict.to_dict()[k] for k in ("islands", "overlapping")}
        return {
            **as_plain(self, "injective", "bijective"),
            **as_plain(self.certificate, "inverted", "degenerate"),
            **as_plain(self, "faces", "certificate"),
            **({"verdict": apart} if apart else {}),
            "unmapped_faces": self.unmapped.tolist(),
            "bent_faces": self.bent.tolist(),
            **({} if self.set_apart is None else self.set_apart.to_dict()),
        }


def certify_map(mesh: MeshData, *, precision: str = "float64", weld: bool | float = False) -> WrittenMap:
    """Certify the map of a file on the faces that have it, optionally rounded to ``precision`` "float32".

    ``weld`` is as in `SeamedMesh.weld`: vertices are welded where they are at one position in the plane.
    """
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.atlas.atlas_verdict import certify as certify_islands
    from quasiharmonic.geometry.exact.certificate import certify
    from quasiharmonic.geometry.mesh.topology import components
    from quasiharmonic.io.models.mesh_maps import find_unmapped
    from quasiharmonic.io.seamed_mesh import SeamedMesh

    unmapped = find_unmapped(mesh)
    rows = np.flatnonzero(~np.isin(mesh.rings.of_triangle, unmapped))
    whole = SeamedMesh(mesh.V, mesh.F, mesh.FT, mesh.vt) if unmapped.size else io.mapped(mesh)
    joined = whole.weld(weld)
    opened = SeamedMesh(joined.V, joined.F[rows], joined.FT[rows], joined.uv).opened()
    V, uv = opened.V, opened.uv
    assert uv is not None
    if precision == "float32":
        with np.errstate(over="ignore"):
            uv = uv.astype(np.float32).astype(np.float64)
    F, FT = np.zeros_like(mesh.F), np.full_like(mesh.F, -1)
    F[rows] = FT[rows] = opened.F
    # The components of the mesh cut at its seams are the islands.
    part = components(opened.F, len(V))[opened.F[:, 0]]
    alone = bool((part == part[:1]).all())
    verdict = None if alone else certify_islands(SeamedMesh(V, F, FT, uv))
    bent = np.setdiff1d(find_bent(mesh, F, uv), unmapped)
    found = WrittenMap(V, F, uv, certify(opened.F, uv, numbers=rows), verdict, mesh.faces, unmapped, bent)
    positive = found.certificate.injective
    if (positive and found.apart) or mesh.vt is None:
        return found
    from quasiharmonic.apps.unwrapping.chart_verdict import certify_defective

    charts = certify_defective(mesh.V, joined.F[rows], uv[opened.F], rows)
    # Repeated triangles overlap although all are positive. Then none needs the opposite winding.
    if charts is None or (positive and charts[1].reversed.size):
        return found
    return replace(found, verdict=charts[0], set_apart=charts[1])


def find_bent(mesh: MeshData, F: NDArray[np.int64], uv: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the faces that get inverted triangles if a reader splits them at their first corner."""
    import numpy as np

    from quasiharmonic.geometry.exact.triangles import find_inverted_fans

    return np.empty(0, dtype=np.int64) if mesh.polygons is None else find_inverted_fans(mesh.polygons, F, uv)


def describe_bent(bent: NDArray[np.int64]) -> str:
    """Return a sentence on the faces of `find_bent`."""
    from quasiharmonic.util.arrays import names_of

    where = names_of("face", "faces", bent)
    return (
        f"A reader that splits faces at their first corner gets inverted triangles in {where}. "
        "qhm check --any-triangulation lists all faces that are not convex."
    )


def add_bent(facts: dict[str, Any], lines: list[str], mesh: MeshData) -> None:
    """Add the faces of `find_bent` of a mesh with texture coordinates to a report."""
    assert mesh.FT is not None
    assert mesh.vt is not None
    bent = find_bent(mesh, mesh.FT, mesh.vt)
    facts["bent_faces"] = bent.tolist()
    if bent.size:
        lines.append(describe_bent(bent))


def describe_maps(mapped: MappedAtlas, written: WrittenMap, output: Path) -> str:
    """Return the text report of a map that was computed and written."""
    from quasiharmonic.problem.result import Status
    from quasiharmonic.util.arrays import count_of

    lines = [f"wrote {output}: {written.summary()}"]
    results = [island.result for island in mapped.islands]
    if not written.injective:
        lines.append(mapped.message)
    # Each surface may be injective although pins make an overlap between surfaces unavoidable.
    if not written.injective or mapped.status is Status.IMPOSSIBLE:
        lines += [r.diagnosis.summary() for r in results if r.diagnosis is not None and r.diagnosis.obstructions][:3]
    iterations = sum(result.n_iterations for result in results)
    seconds = sum(result.seconds for result in results)
    lines.append(f"{count_of('iteration', 'iterations', iterations)}, {seconds:.3g} s, {mapped.linear_solver}")
    return "\n".join(lines)


def describe_end(mapped: MappedAtlas, written: WrittenMap) -> list[str]:
    """Return the message of an injective map for the text report, where `describe_maps` does not imply it."""
    from quasiharmonic.problem.result import Status

    ended_early = mapped.status in (Status.INTERRUPTED, Status.TIME_LIMIT)
    # The other messages say that every triangle is positive, which is not true of mirrored islands.
    if not written.injective or mapped.status is Status.INJECTIVE or (written.mirrored and not ended_early):
        return []
    return [mapped.message]
