"""The surface on the page: from a file, from what was dropped on the page, or one of ours."""

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

#: What may be dropped on the page. (A .gltf is in several files, of which a page hands over one.)
SUFFIXES = ".obj", ".off", ".ply", ".stl", ".glb"
#: More than this is neither drawn in time nor followed by a hand.
MOST_TRIANGLES = 1_000_000


@dataclass(frozen=True, eq=False)
class Sheet:
    """A connected surface with a boundary, and the file it came from.

    Attributes
    ----------
    name : str
        Of the file, without its folder.
    mesh : MeshData
        As it was read; what is written carries its map.
    seamed : SeamedMesh
        The mesh, cut open where it does not lie flat.
    island : Island
        All of it: what is mapped.
    flags : tuple of str
        What tells ``qhm map`` to take the surface so.
    fixed : (k,) int64 or None
        Vertices of the island that the file holds, where it says so by a list of its own.
    """

    name: str
    mesh: io.MeshData
    seamed: SeamedMesh
    island: Island
    flags: tuple[str, ...] = ()
    fixed: np.ndarray | None = field(default=None)

    def written(self, uv: FloatArray) -> bytes:
        """The file with a map (n, 2) of the island as its texture coordinates: OBJ, every digit kept."""
        mesh = self.mesh.with_places(self.seamed.with_places([uv]))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "map.obj"
            io.write_mapped(path, mesh)
            return path.read_bytes()

    def numbers(self, vertices: list[int]) -> list[int]:
        """What the file calls some vertices of the island."""
        return [int(self.island.vertices[v]) for v in vertices]


def first_sheet() -> Sheet:
    """The surface for those who come without one: a cat's head."""
    return sheet_of(io.MeshData(*cat(40), source="cat.obj"), "cat.obj")


def read_sheet(path: Path) -> Sheet:
    """Read the surface that the command was given.

    Parameters
    ----------
    path : Path
        A file, or a folder with ``input.obj`` and perhaps ``handles.txt``.

    Raises
    ------
    ValueError, OSError
        When it is none, or none that has one piece and a boundary.
    """
    mesh_path, fixed_path = io.problem_files(path)
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    return sheet_of(mesh, mesh_path.name, fixed)


def dropped_sheet(name: str, content: bytes) -> Sheet:
    """Read the surface that was dropped on the page.

    Parameters
    ----------
    name : str
        Of the file on the visitor's side, of which the ending counts.
    content : bytes

    Raises
    ------
    ValueError
        When it is none; the message speaks of the visitor's file, and of no place on this side.
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
    """Make a sheet of a mesh, cut open if it is closed.

    Raises
    ------
    ValueError
        When it has no triangles or too many of them, or falls into several pieces.
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
        # An atlas of many islands: the surface that they are parts of.
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
