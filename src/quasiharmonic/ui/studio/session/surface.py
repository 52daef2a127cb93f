"""The surface of a page: from a file, from an upload, or built in."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from quasiharmonic import io
from quasiharmonic.apps.atlas import seam_cuts
from quasiharmonic.geometry.surfaces import cat
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.util.arrays import FloatArray

#: Maximum number of triangles; larger meshes are too slow to draw and drag.
MAX_TRIANGLES = 1_000_000


@dataclass(frozen=True, eq=False)
class Sheet:
    """Connected surface with a boundary, and its file."""

    name: str  # File name without folder
    mesh: io.MeshData  # The mesh as read; written files contain it with its map
    seamed: SeamedMesh  # The mesh, cut open if it is closed
    island: Island  # The single island, which is mapped
    flags: tuple[str, ...] = ()  # Options of ``qhm map`` that produce the same surface
    fixed: np.ndarray | None = field(default=None)  # (k,): fixed vertices of the island, if the file comes with a list

    def written(self, uv: FloatArray) -> bytes:
        """Return an OBJ file with a map (n, 2) of the island as texture coordinates, without rounding."""
        mesh = self.mesh.with_places(self.seamed.with_places([uv]))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "map.obj"
            io.write_mapped(path, mesh)
            return path.read_bytes()

    def numbers(self, vertices: list[int]) -> list[int]:
        """Return the file's indices of vertices of the island."""
        return [int(self.island.vertices[v]) for v in vertices]


def make_first_sheet() -> Sheet:
    """Return the built-in surface: a cat's head."""
    return make_sheet(io.MeshData(*cat(40), source="cat.obj"), "cat.obj")


def read_sheet(path: Path) -> Sheet:
    """Read the surface given to the command: a file, or a folder with ``input.obj`` and perhaps ``handles.txt``.

    ValueError or OSError if the file is not a surface with one component and a boundary.
    """
    mesh_path, fixed_path = io.problem_files(path)
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    return make_sheet(mesh, mesh_path.name, fixed)


def read_upload(name: str, content: bytes) -> Sheet:
    """Read an uploaded surface; of its name on the user's side only the suffix matters.

    ValueError if the file is not a valid surface. The message names the user's file, not a path of this machine.
    """
    shown = PurePosixPath(name.replace("\\", "/")).name[:100]
    # A page uploads one file, without further files that it may refer to.
    suffix = io.find_format(shown, "read", "single_file").suffix
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"dropped{suffix}"
        path.write_bytes(content)
        try:
            mesh = io.read_mesh(path)
        except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
            raise ValueError(str(error).replace(str(path), shown)) from None
    return make_sheet(mesh, shown)


def make_sheet(mesh: io.MeshData, name: str, fixed: np.ndarray | None = None) -> Sheet:
    """Return the sheet of a mesh, cut open if it is closed.

    ValueError if it has no triangles, too many triangles, or several components.
    """
    if len(mesh.F) > MAX_TRIANGLES:
        raise ValueError(
            f"{name} has {len(mesh.F):,} triangles, but the page shows at most {MAX_TRIANGLES:,}: "
            "use the command qhm map, or coarsen the mesh first"
        )
    if not len(mesh.F):
        raise ValueError(f"{name} has no triangles")
    seamed, flags = io.seamed(mesh), []
    if len(seamed.islands) > 1 and not seamed.seamless:
        # An atlas of several islands: use the surface without its seams.
        seamed, flags = SeamedMesh(mesh.V, mesh.F), ["--seams", "none"]
    if len(seamed.islands) == 1 and not _has_boundary(seamed.islands[0]):
        seamed = seam_cuts.cut_apart(seamed, polygons=mesh.polygons, disks_too=False, reach=False)
        flags.append("--cut")
    islands = seamed.islands
    if len(islands) != 1:
        sizes = ", ".join(f"{len(island.F):,}" for island in islands[:5])
        raise ValueError(
            f"{name} has {len(islands)} connected parts (of {sizes}{' …' if len(islands) > 5 else ''} triangles), but "
            "the page supports only one: use the command qhm map or qhm flatten"
        )
    (island,) = islands
    own = None if fixed is None else np.flatnonzero(np.isin(island.vertices, fixed))
    return Sheet(name, mesh, seamed, island, tuple(flags), own)


def _has_boundary(island: Island) -> bool:
    from quasiharmonic.geometry.mesh.topology import boundary_edges

    return bool(len(boundary_edges(island.F, len(island.V))))
