"""The surface of a page: from a file, from an upload, or built in."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from quasiharmonic import io
from quasiharmonic.apps.atlas import seaming
from quasiharmonic.geometry.mesh.seams import Island, SeamedMesh
from quasiharmonic.geometry.surfaces import cat
from quasiharmonic.util.arrays import FloatArray

#: Suffixes of files that can be uploaded. A .gltf consists of several files, so it is not supported.
SUFFIXES = ".obj", ".off", ".ply", ".stl", ".glb"
#: Maximum number of triangles; larger meshes are too slow to draw and drag.
MOST_TRIANGLES = 1_000_000


@dataclass(frozen=True, eq=False)
class Sheet:
    """Connected surface with a boundary, and its file.

    Attributes
    ----------
    name : str
        File name without folder.
    mesh : MeshData
        The mesh as read; written files contain it with its map.
    seamed : SeamedMesh
        The mesh, cut open if it is closed.
    island : Island
        The single island, which is mapped.
    flags : tuple of str
        Options of ``qhm map`` that produce the same surface.
    fixed : (k,) int64 or None
        Fixed vertices of the island, if the file comes with a list.
    """

    name: str
    mesh: io.MeshData
    seamed: SeamedMesh
    island: Island
    flags: tuple[str, ...] = ()
    fixed: np.ndarray | None = field(default=None)

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


def first_sheet() -> Sheet:
    """Return the built-in surface: a cat's head."""
    return sheet_of(io.MeshData(*cat(40), source="cat.obj"), "cat.obj")


def read_sheet(path: Path) -> Sheet:
    """Read the surface given to the command.

    Parameters
    ----------
    path : Path
        A file, or a folder with ``input.obj`` and perhaps ``handles.txt``.

    Raises
    ------
    ValueError, OSError
        If the file is not a surface with one component and a boundary.
    """
    mesh_path, fixed_path = io.problem_files(path)
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    return sheet_of(mesh, mesh_path.name, fixed)


def dropped_sheet(name: str, content: bytes) -> Sheet:
    """Read an uploaded surface.

    Parameters
    ----------
    name : str
        File name on the user's side; only its suffix matters.
    content : bytes

    Raises
    ------
    ValueError
        If the file is not a valid surface. The message names the user's file, not a path of this machine.
    """
    shown = PurePosixPath(name.replace("\\", "/")).name[:100]
    suffix = PurePosixPath(shown).suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{shown}: unsupported mesh format; supported: {', '.join(SUFFIXES)}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"dropped{suffix}"
        path.write_bytes(content)
        try:
            mesh = io.read_mesh(path)
        except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
            raise ValueError(str(error).replace(str(path), shown)) from None
    return sheet_of(mesh, shown)


def sheet_of(mesh: io.MeshData, name: str, fixed: np.ndarray | None = None) -> Sheet:
    """Return the sheet of a mesh, cut open if it is closed.

    Raises
    ------
    ValueError
        If it has no triangles, too many triangles, or several components.
    """
    if len(mesh.F) > MOST_TRIANGLES:
        raise ValueError(
            f"{name} has {len(mesh.F):,} triangles, and the page shows {MOST_TRIANGLES:,} at most: "
            "use the command qhm map, or coarsen it first"
        )
    if not len(mesh.F):
        raise ValueError(f"{name} has no triangles")
    seamed, flags = io.seamed(mesh), []
    if len(seamed.islands) > 1 and not seamed.seamless:
        # An atlas of several islands: use the surface without its seams.
        seamed, flags = SeamedMesh(mesh.V, mesh.F), ["--seams", "none"]
    if len(seamed.islands) == 1 and not _has_boundary(seamed.islands[0]):
        seamed = seaming.cut_apart(seamed, polygons=mesh.polygons, disks_too=False, reach=False)
        flags.append("--cut")
    islands = seamed.islands
    if len(islands) != 1:
        sizes = ", ".join(f"{len(island.F):,}" for island in islands[:5])
        raise ValueError(
            f"{name} is in {len(islands)} pieces (of {sizes}{' …' if len(islands) > 5 else ''} triangles), and the "
            "page takes one: qhm map and qhm flatten take all of them"
        )
    (island,) = islands
    own = None if fixed is None else np.flatnonzero(np.isin(island.vertices, fixed))
    return Sheet(name, mesh, seamed, island, tuple(flags), own)


def _has_boundary(island: Island) -> bool:
    from quasiharmonic.geometry.mesh.topology import boundary_edges

    return bool(len(boundary_edges(island.F, len(island.V))))
