"""Write a map, read it back, and certify the file as a reader gets it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict
    from quasiharmonic.geometry.exact.certificate import Certificate
    from quasiharmonic.io import MeshData


@dataclass(frozen=True, eq=False)
class WrittenMap:
    """Exact certificate of a file's map."""

    V: NDArray[np.float64]  # (m, 3)
    F: NDArray[np.int64]  # (f, 3)
    uv: NDArray[np.float64]  # (m, 2): the mesh and its map, cut at seams: one vertex per texture coordinate of a vertex
    certificate: Certificate  # Certificate of the whole map in the plane
    verdict: AtlasVerdict | None  # Certificates of the islands; None for a single island
    faces: int  # Number of faces in the file

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
        text = self.certificate.summary() if self.verdict is None else self.verdict.summary()
        if self.faces < len(self.F):
            text += f"\nThe verdict is on the {len(self.F)} triangles that stand for its {self.faces} faces."
        return text

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as the first entries of the JSON report."""
        apart = {} if self.verdict is None else {k: self.verdict.to_dict()[k] for k in ("islands", "overlapping")}
        return {
            "injective": self.injective,
            "bijective": self.bijective,
            "inverted": self.certificate.inverted.tolist(),
            "degenerate": self.certificate.degenerate.tolist(),
            "faces": self.faces,
            "certificate": self.certificate.to_dict(),
            **({"verdict": apart} if apart else {}),
        }


def certify_map(mesh: MeshData, *, precision: str = "float64") -> WrittenMap:
    """Certify the map of a file, optionally rounded to ``precision`` "float32"."""
    import numpy as np

    from quasiharmonic import io
    from quasiharmonic.apps.atlas.atlas_verdict import certify as certify_islands
    from quasiharmonic.geometry.exact.certificate import certify
    from quasiharmonic.geometry.mesh.topology import components
    from quasiharmonic.io.seamed_mesh import SeamedMesh

    V, F, uv = io.cut_at_seams(mesh)
    if precision == "float32":
        with np.errstate(over="ignore"):
            uv = uv.astype(np.float32).astype(np.float64)
    # The components of the mesh cut at its seams are the islands.
    part = components(F, len(V))[F[:, 0]]
    alone = bool((part == part[:1]).all())
    verdict = None if alone else certify_islands(SeamedMesh(V, F, F, uv))
    return WrittenMap(V, F, uv, certify(F, uv), verdict, mesh.faces)


def tell_losses(output: Path, mesh: MeshData) -> None:
    """Report on standard error which data of a mesh the output format cannot store."""
    from quasiharmonic import io
    from quasiharmonic.ui.cli.streams import tell

    if lost := io.not_held(output, mesh):
        tell(f"{output} will not have: {'; '.join(lost)}")


def write(output: Path, mesh: MeshData) -> WrittenMap:
    """Write a mesh with its map, read the file back, and certify it."""
    from quasiharmonic import io
    from quasiharmonic.ui.cli import report

    tell_losses(output, mesh)
    io.write_mapped(output, mesh)
    with report.after_writing(output):
        return certify_map(io.read_written(output, mesh))
