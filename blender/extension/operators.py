"""Blender operators on UVs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from quasiharmonic import atlas, repair
from quasiharmonic.apps.atlas import seam_cuts
from quasiharmonic.apps.atlas.mapped_atlas import each_island
from quasiharmonic.atlas import AtlasVerdict, Island, SeamedMesh
from quasiharmonic.energies.polishing import polish_result
from quasiharmonic.geometry.exact.triangles import find_concave, find_overlapping
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.problem.result import MapResult, Status
from quasiharmonic.results import Step
from quasiharmonic.solver.mapping import solve
from quasiharmonic.targets.boundary.boundary_to import fit_boundary
from quasiharmonic.targets.boundary.corner_pins import CornerSpec
from quasiharmonic.util.arrays import IntArray, count_of
from quasiharmonic.util.options import ENERGY_LABELS, PolishOptions

from . import outline, pins, surface
from .advice import translate_advice
from .job import Work, Working
from .surface import Refused

_ENERGIES = [(name, label.capitalize(), f"The energy {name}") for name, label in ENERGY_LABELS.items()]


class UvWorking(Working):
    """An operator on the UVs of objects, one after another: the selected ones, or in edit mode those edited.

    `prepare_one` returns the work on the mesh `data` of one object, and reads it into `surface`. `finish_one` receives
    the result. If the work on an object fails, none is changed.
    """

    def prepare(self, context: bpy.types.Context) -> Work:
        """Return the work on all objects."""
        parts = []
        for thing in self.find_objects(context):
            self.data = thing.data
            work = self.prepare_one(context)
            parts.append((thing, self.surface, work))
        self._parts = parts
        return lambda reports_progress: [work(reports_progress) for _, _, work in parts]

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write the results of all objects."""
        for (thing, here, _), one in zip(self._parts, result, strict=True):
            self.data, self.surface = thing.data, here
            self.label = f"{self.bl_label}: {thing.name}: " if len(self._parts) > 1 else f"{self.bl_label}: "
            self.finish_one(context, one)

    def prepare_one(self, context: bpy.types.Context) -> Work:
        """Return the work on one object, whose mesh is `data`. It must not access Blender's data."""
        raise NotImplementedError

    def finish_one(self, context: bpy.types.Context, result: Any) -> None:
        """Write the result of one object."""
        raise NotImplementedError

    def find_objects(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """Return the mesh objects to work on, the active one first; of objects that share a mesh the first."""
        found: list[bpy.types.Object] = []
        for thing in super().find_objects(context):
            if thing == context.active_object or len(thing.data.polygons):
                found += [] if any(other.data == thing.data for other in found) else [thing]
        return found

    def read(self, *, whole: bool = True) -> SeamedMesh:
        """Return the object's mesh; in edit mode, only islands with selected faces unless ``whole`` is true."""
        self.surface = surface.read(
            self.data, edited=self.mode == "EDIT", chosen_only=not whole and self.mode == "EDIT"
        )
        return self.surface.mesh

    def read_map(self, *, whole: bool = True) -> SeamedMesh:
        """Return the mesh as `read` does; require a UV layer."""
        mesh = self.read(whole=whole)
        surface.require_map(self.surface)
        return mesh

    def take(self, mapped: SeamedMesh, remark: str = "") -> None:
        """Write a map to Blender and report the verdict of the map as stored there."""
        stored = surface.write(self.data, self.surface, mapped)
        verdict = surface.certify(stored)
        lost = np.setdiff1d(verdict.inverted, surface.certify(mapped).inverted)
        if lost.size:
            remark = (
                f" {count_of('triangle is', 'triangles are', lost.size)} too narrow for Blender's single precision."
            )
        changed = np.zeros(len(stored.F), dtype=np.bool_)
        changed[stored.mapped] = True
        others = surface.describe_others([(self.surface, stored.uv, changed)])
        kind = "INFO" if verdict.injective else "WARNING"
        self.report({kind}, f"{self.label}{_describe(verdict)}{others}{remark}")


class ChosenWorking(UvWorking):
    """An operator that in edit mode works on the selected islands only."""

    whole: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="All islands", description="In edit mode also islands without a selected face", default=False
    )


class QHM_OT_check(UvWorking):
    """Select faces whose UVs are inverted, degenerate or overlapping. The check is exact."""

    bl_idname = "uv.qhm_check"
    bl_label = "Check UVs"

    def prepare_one(self, context: bpy.types.Context) -> Work:
        """Return the work that certifies the map."""
        mesh, polygons = self.read_map(), self.surface.polygons

        def work(reports_progress: Callable[[Step], None]) -> tuple[AtlasVerdict, IntArray, IntArray]:
            verdict = surface.certify(mesh)
            return verdict, _lying(mesh, verdict), _bent(mesh, polygons, verdict)

        return work

    def finish_one(self, context: bpy.types.Context, result: Any) -> None:
        """Select the faces found and report the verdict."""
        verdict, lying, bent = result
        self._found = [] if self.data == self._parts[0][0].data else self._found
        face = self.surface.polygons.of_triangle
        inverted = np.unique(face[verdict.inverted])
        chosen = np.union1d(inverted, face[lying])
        self._found.append((self.data, self.surface, chosen))
        if len(self._found) == len(self._parts):
            surface.select_faces(context, self._found)
        text = f"{count_of('face', 'faces', len(chosen))} selected, of which {len(inverted)} inverted. "
        text += _describe(verdict)
        if len(bent):
            text += (
                f" {count_of('face is', 'faces are', len(bent))} not convex: cut into other triangles, some would flip."
            )
        sound = verdict.bijective and not len(verdict.overlapping)
        self.report({"INFO" if sound else "WARNING"}, f"{self.label}{text}")


class QHM_OT_repair(ChosenWorking):
    """Untangle inverted faces. Borders and pins stay unchanged, and so does every UV that need not move."""

    bl_idname = "uv.qhm_repair"
    bl_label = "Repair UVs"
    unmirror: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Turn mirrored islands over", description="Otherwise they are left, as some are on purpose", default=False
    )

    def prepare_one(self, context: bpy.types.Context) -> Work:
        """Return the work that repairs the map."""
        mesh = self.read_map(whole=self.whole)
        unmirror, fixed = self.unmirror, pins.list_pinned(self.surface)

        def work(reports_progress: Callable[[Step], None]) -> tuple[SeamedMesh, str]:
            if not unmirror and surface.reflect_single(mesh) is not mesh:
                return mesh, ""
            result = repair(
                mesh.V, mesh.F, mesh.uv, FT=mesh.FT, fixed=fixed, unmirror=unmirror, callback=reports_progress
            )
            reasons = " ".join(island.reason for island in result.islands if island.reason)
            return result.mesh, f" {translate_advice(' '.join(reasons.split()))}" if reasons else ""

        return work

    def finish_one(self, context: bpy.types.Context, result: Any) -> None:
        """Write the map and report the result."""
        self.take(*result)


class QHM_OT_flatten(ChosenWorking):
    """Flatten the mesh with free borders, without inversion or overlap; cut at marked seams or along UV borders."""

    bl_idname = "uv.qhm_flatten"
    bl_label = "Flatten"
    cut: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Find seams", description="Cut where the surface does not lie flat well", default=False
    )
    pack: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Pack", description="Lay islands into the unit square, all at one texel density", default=True
    )
    energy: bpy.props.EnumProperty(name="Keep", items=_ENERGIES)  # type: ignore[valid-type]

    def prepare_one(self, context: bpy.types.Context) -> Work:
        """Return the work that cuts and flattens the mesh."""
        mesh, polygons = self.read(), self.surface.polygons
        here = self.surface
        seams = surface.marked_edges(self.data, "use_seam")
        cut, pack, energy, whole = self.cut, self.pack, self.energy, self.whole or self.mode != "EDIT"

        def work(reports_progress: Callable[[Step], None]) -> SeamedMesh:
            opened = mesh
            if len(seams):
                opened = seam_cuts.cut_along(mesh, seams, polygons=polygons)
            elif here.blank:
                opened = SeamedMesh(mesh.V, mesh.F)
            opened = surface.restrict(opened, here.shown) if whole else here.choose(opened)
            if cut:
                opened = seam_cuts.cut_apart(opened, polygons=polygons)
            _require_borders(opened)
            if any(pins.find_pins(here, island)[0].size for island in opened.islands):
                return pins.flatten_with_pins(here, opened, energy, reports_progress)
            mapped = atlas.flatten(opened, energy=energy, callback=reports_progress)
            if mapped.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            return atlas.pack(mapped.mesh) if pack else mapped.mesh

        return work

    def finish_one(self, context: bpy.types.Context, result: Any) -> None:
        """Write the map and report the result."""
        self.take(result)


class QHM_OT_reduce(ChosenWorking):
    """Reduce stretch with fixed or free borders, without inverting a face."""

    bl_idname = "uv.qhm_reduce_stretch"
    bl_label = "Reduce Stretch"
    free: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Free borders", description="Let borders go where stretch is least", default=False
    )
    energy: bpy.props.EnumProperty(name="Keep", items=_ENERGIES)  # type: ignore[valid-type]

    def prepare_one(self, context: bpy.types.Context) -> Work:
        """Return the work that reduces the distortion."""
        mesh, here = self.read_map(whole=self.whole), self.surface
        free, energy = self.free, self.energy
        return lambda reports_progress: pins.reduce_stretch(
            here, mesh, free=free, energy=energy, reports_progress=reports_progress
        )

    def finish_one(self, context: bpy.types.Context, result: Any) -> None:
        """Write the map and report the result."""
        self.take(result)


class QHM_OT_fit(ChosenWorking):
    """Fit an island to an outline: a rectangle, a disk, a letter, or a curve of the scene."""

    bl_idname = "uv.qhm_fit"
    bl_label = "Fit to Outline"
    to: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Outline",
        items=[
            ("RECTANGLE", "Rectangle", "As wide as the unit square, and as high as is said below"),
            ("DISK", "Disk", "A disk in the unit square"),
            ("LETTER", "Letter", "A letter in Blender's own font"),
            ("CURVE", "Curve", "A closed curve, text or flat mesh of the scene, seen from above"),
        ],
    )
    height: bpy.props.FloatProperty(name="Height", default=1.0, min=0.01, max=100.0)  # type: ignore[valid-type]
    letter: bpy.props.StringProperty(name="Letter", default="G")  # type: ignore[valid-type]
    curve: bpy.props.StringProperty(name="Curve", description="Name of the object")  # type: ignore[valid-type]

    def find_objects(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """Return the objects to fit; the outline is not one of them."""
        found = super().find_objects(context)
        return [thing for thing in found if self.to != "CURVE" or thing.name != self.curve or thing == found[0]]

    def prepare_one(self, context: bpy.types.Context) -> Work:
        """Return the work that fits the boundary to the outline, with corners detected, and computes the map."""
        mesh, here = self.read(), self.surface
        if here.blank:
            mesh = SeamedMesh(mesh.V, mesh.F)
        mesh = surface.restrict(mesh, here.shown) if self.whole or self.mode != "EDIT" else here.choose(mesh)
        if len(mesh.islands) != 1:
            raise Refused(f"there are {len(mesh.islands)} islands: in edit mode, select faces of the one to fit only")
        _require_borders(mesh)
        contours = self._contours(context)
        corners = CornerSpec("auto") if self.to == "RECTANGLE" else None

        def find(island: Island, reports_progress: Callable[[Step], None]) -> MapResult:
            problem = fit_boundary(island.V, island.F, contours, corners=corners).problem
            problem = pins.hold_pins(problem, *pins.find_pins(here, island))
            result = solve(problem, callback=reports_progress)
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            if not result.injective:
                reason = result.status.value if result.diagnosis is None else result.diagnosis.summary()
                raise Refused(f"no map without flips was found. {reason}")
            return polish_result(
                problem, result, PolishOptions(energy="blend", max_iterations=20, callback=reports_progress)
            )

        return lambda reports_progress: (
            each_island(mesh, lambda island: find(island, reports_progress), reflect=False).mesh
        )

    def finish_one(self, context: bpy.types.Context, result: Any) -> None:
        """Write the map and report the result."""
        self.take(result)

    def _contours(self, context: bpy.types.Context) -> list[Any]:
        """Return the outline as contours in the unit square; a rectangle may be higher."""
        if self.to == "RECTANGLE":
            return outline.rectangle(self.height)
        if self.to == "DISK":
            return outline.disk()
        if self.to == "LETTER":
            return outline.of_letter(self.letter)
        return outline.of_named(context, self.curve)


def _require_borders(mesh: SeamedMesh) -> None:
    """Raise `Refused` if the mesh has no border along which it can be flattened."""
    if any(not len(boundary_edges(island.F, len(island.vertices))) for island in mesh.islands):
        raise Refused("the mesh, or a part of it, is closed: mark seams, or use Cut and Flatten")


def _describe(verdict: AtlasVerdict) -> str:
    """Return the first lines of a verdict as sentences in one line, and how to turn mirrored islands over."""
    lines = verdict.summary().splitlines()[:3]
    words = " ".join(f"{line.replace('- island', 'Island').removesuffix('.')}." for line in lines)
    if verdict.mirrored.size:
        words += f" {QHM_OT_repair.bl_label} has the option Turn mirrored islands over."
    return words


def _lying(mesh: SeamedMesh, verdict: AtlasVerdict) -> IntArray:
    """Return the overlapping triangles among islands without inverted triangles, in ascending order."""
    concerned = set(verdict.overlapping.ravel().tolist())
    concerned |= {k for k, one in enumerate(verdict.islands) if one.injective and not one.bijective}
    if not concerned:
        return np.empty(0, dtype=np.int64)
    triangles = np.concatenate([verdict.islands[k].triangles for k in sorted(concerned)])
    turned = np.isin(triangles, _mirrored(verdict))
    FT = np.where(turned[:, None], mesh.FT[triangles, ::-1], mesh.FT[triangles])
    return np.sort(triangles[find_overlapping(FT, mesh.uv)])


def _bent(mesh: SeamedMesh, polygons: Any, verdict: AtlasVerdict) -> IntArray:
    """Return faces that are not convex in the plane although no triangle of theirs is inverted, in ascending order."""
    mirrored = polygons.of_triangle[_mirrored(verdict)]
    front, back = (find_concave(polygons, mesh.FT, mesh.uv * [side, 1.0]) for side in (1.0, -1.0))
    bent = np.union1d(np.setdiff1d(front, mirrored), np.intersect1d(back, mirrored))
    shown = polygons.of_triangle[mesh.mapped]
    return np.intersect1d(np.setdiff1d(bent, polygons.of_triangle[verdict.inverted]), shown)


def _mirrored(verdict: AtlasVerdict) -> IntArray:
    """Return the triangles of mirrored islands."""
    return np.concatenate(
        [np.empty(0, dtype=np.int64), *(verdict.islands[k].triangles for k in verdict.mirrored.tolist())]
    )


CLASSES = (QHM_OT_check, QHM_OT_repair, QHM_OT_flatten, QHM_OT_reduce, QHM_OT_fit)
