"""The model of a page: from a file, from an upload, or built in; and the surface in it that is mapped."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np

from quasiharmonic import io
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh, clean
from quasiharmonic.apps.unwrapping.model_files import divide_polygons
from quasiharmonic.geometry.surfaces import cat
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.problem.inspection import MeshReport, inspect_mesh
from quasiharmonic.ui.studio.validation import stored_file
from quasiharmonic.util.arrays import IntArray

#: Maximum number of triangles; larger meshes are too slow to draw and drag.
MAX_TRIANGLES = 1_000_000
#: Maximum absolute coordinate; graphics cards compute in single precision.
MAX_COORDINATE = 1e15
# Defects that do not prevent a model from being mapped as it is in the file.
_HARMLESS = {"vertices without triangle", "vertices where surfaces touch"}


@dataclass(frozen=True, eq=False)
class PageSurface:
    """Model of a page; values of this type are called ``sheet``, as ``surface`` is a part.

    The functions that map accept only surfaces. So a model with defects is cleaned first, and the cleaned surface is
    mapped. Files that are written have the model's own vertices and faces, all reversed if the user has turned it over.
    """

    name: str  # File name without folder
    mesh: io.MeshData  # The mesh as read
    surface: io.MeshData  # The mesh that is mapped
    report: MeshReport  # Topology and defects of the model
    cleaned: CleanedMesh | None = None  # How the surface was made from the model; None if they are the same
    turned: bool = False  # Whether the triangles of the surface are reversed
    fixed: IntArray | None = None  # (k,): fixed vertices, if the file comes with a list
    texture: io.Texture | None = None  # The model's own texture
    posed: bool = False  # Whether of the map only the positions of the fixed vertices count
    # A name that stays the same in other processes; another model has another one
    key: str = field(init=False, default_factory=lambda: secrets.token_hex(8))

    @property
    def is_file(self) -> bool:
        """Whether the surface has the vertices and triangles of the file."""
        return self.cleaned is None and not self.turned

    @property
    def meshes(self) -> IntArray | None:
        """Number of the mesh of each vertex of the model; None if the file has one mesh."""
        return None if self.mesh.carried is None else self.mesh.carried.number_meshes()

    @cached_property
    def inward(self) -> int:
        """Number of closed components that are inside out."""
        if self.cleaned is not None:
            found = int(np.count_nonzero(self.cleaned.facing < 0))
            return int(np.count_nonzero(self.cleaned.facing > 0)) if self.turned else found
        return inspect_mesh(self.surface.V, self.surface.F).inward if self.turned else self.report.inward

    @cached_property
    def unmapped(self) -> IntArray:
        """Triangles of the surface without texture coordinates in a file in which others have some."""
        if self.mesh.FT is None:
            return np.empty(0, dtype=np.int64)
        bare = (self.from_file(self.mesh.FT) < 0).any(axis=1)
        return np.flatnonzero(bare & (not bare.all()))

    @property
    def has_complete_map(self) -> bool:
        """Whether the file has texture coordinates for every triangle of the surface."""
        FT = self.mesh.FT
        return self.mesh.vt is not None and FT is not None and bool((self.from_file(FT) >= 0).all())

    def initial_map(self) -> SeamedMesh:
        """Return the surface with the seams and the map of the file, without map if the file has none."""
        if self.mesh.FT is None or self.mesh.vt is None or (not self.is_file and not self.has_complete_map):
            return SeamedMesh(self.surface.V, self.surface.F)
        if self.is_file:
            return io.seamed(self.mesh)
        return SeamedMesh(self.surface.V, self.surface.F, self.from_file(self.mesh.FT), self.mesh.vt)

    def from_file(self, corners: IntArray) -> IntArray:
        """Return values at the corners of the file's triangles (f, 3) at those of the surface."""
        if self.cleaned is not None:
            corners = self.cleaned.take_corners(corners)
        return corners[:, (0, 2, 1)] if self.turned else corners

    def find_edges(self, edges: IntArray) -> IntArray:
        """Return edges (k, 2) of the file's mesh by the vertices of the cleaned surface, where it has them."""
        assert self.cleaned is not None
        F, sides = self.cleaned.F, self.cleaned.mark_edges(edges)
        return np.unique(np.sort(np.stack([F[sides], F[:, (1, 2, 0)][sides]], axis=1), axis=1), axis=0)

    def mapped_file(self, mesh: SeamedMesh) -> io.MeshData:
        """Return the file's mesh with a map of the surface, turned over if the surface is.

        Polygons that seams cross become triangles.
        """
        FT = mesh.FT[:, (0, 2, 1)] if self.turned else mesh.FT
        if self.cleaned is not None:
            FT = self.cleaned.restore_corners(FT)
        mapped = divide_polygons(replace(self.mesh, vt=mesh.uv, FT=FT))[0]
        return mapped.turn_over() if self.turned else mapped

    def clean_up(self) -> PageSurface:
        """Return the model as read, with a cleaned surface, in which vertices at equal positions are one."""
        cleaned = clean(self.mesh.V, self.mesh.F, meshes=self.meshes)
        surface = io.MeshData(cleaned.V, cleaned.F, source=self.mesh.source)
        return replace(self, surface=surface, cleaned=cleaned, turned=False, fixed=None)

    def turn_over(self) -> PageSurface:
        """Return the model with the triangles of its surface reversed."""
        surface = io.MeshData(self.surface.V, self.surface.F[:, (0, 2, 1)], source=self.mesh.source)
        return replace(self, surface=surface, turned=not self.turned)


def make_first_sheet() -> PageSurface:
    """Return the built-in surface: a cat's head."""
    return make_sheet(io.MeshData(*cat(40), source="cat.obj"), "cat.obj")


def read_sheet(path: Path) -> PageSurface:
    """Read the model given to the command: a file, or a folder with ``input.obj`` and perhaps ``handles.txt``.

    ValueError or OSError if the file is not a model.
    """
    mesh_path, fixed_path = io.problem_files(path)
    mesh = io.read_mesh(mesh_path)
    fixed = None if fixed_path is None else io.read_handles(fixed_path, len(mesh.V))
    return make_sheet(mesh, mesh_path.name, fixed)


def read_upload(name: str, content: bytes) -> PageSurface:
    """Read an uploaded model; of its name on the user's side only the suffix matters.

    ValueError if the file is not a valid model. The message names the user's file, not a path of this machine.
    """
    shown = PurePosixPath(name.replace("\\", "/")).name
    # A page uploads one file, without further files that it may refer to.
    suffix = io.find_format(shown, "read", "single_file").suffix
    with stored_file(f"dropped{suffix}", content) as path:
        try:
            mesh = io.read_mesh(path)
            sheet = make_sheet(mesh, shown)
        except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
            raise ValueError(str(error).replace(str(path), shown)) from None
    return replace(sheet, mesh=replace(sheet.mesh, source=shown))


def make_sheet(mesh: io.MeshData, name: str, fixed: IntArray | None = None) -> PageSurface:
    """Return the sheet of a mesh; ValueError if it has no triangles, too many, or only degenerate ones."""
    if len(mesh.F) > MAX_TRIANGLES:
        raise ValueError(
            f"{name} has {len(mesh.F):,} triangles, but the page shows at most {MAX_TRIANGLES:,}: "
            "use the command qhm unwrap, or coarsen the mesh first"
        )
    if not len(mesh.F):
        raise ValueError(f"{name} has no triangles")
    if (largest := float(np.abs(mesh.V).max())) > MAX_COORDINATE:
        most = f"at most {MAX_COORDINATE:.0e} can be drawn: scale it"
        raise ValueError(f"{name} has coordinates up to {largest:.0e}, but {most}")
    report = inspect_mesh(mesh.V, mesh.F)
    sound = not any(found.size for what, found in report.defects.items() if what not in _HARMLESS)
    texture = io.own_texture(mesh) if mesh.source else None
    if sound:
        return PageSurface(name, mesh, mesh, report, fixed=fixed, texture=texture)
    sheet = PageSurface(name, mesh, mesh, report, texture=texture).clean_up()
    own = None if fixed is None or sheet.cleaned is None else np.flatnonzero(np.isin(sheet.cleaned.vertices, fixed))
    return replace(sheet, fixed=own)
