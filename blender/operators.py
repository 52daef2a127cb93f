"""What can be done to UVs: one operator for each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from quasiharmonic import Step, atlas, repair, targets
from quasiharmonic.apply.fitting import laid_along
from quasiharmonic.atlas import seaming
from quasiharmonic.atlas.mapped import each_island
from quasiharmonic.energy.polishing import polished
from quasiharmonic.mesh.seams import Island, SeamedMesh
from quasiharmonic.result import MapResult, Status
from quasiharmonic.search.solving import solve

from . import surface
from .job import Working
from .surface import Refused

_ENERGIES = [
    ("symmetric-dirichlet", "Lengths and angles", "Symmetric Dirichlet energy: neither stretched nor shrunk"),
    ("mips", "Angles", "MIPS energy: angles alone"),
    ("blend", "Worst stretch", "A blend that minds the worst triangles"),
]
Work = Callable[[Callable[[Step], None]], Any]


class UvWorking(Working):
    """An operator on the UVs of the active object."""

    whole: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="All islands", description="Also islands without a selected face", default=False
    )

    def read(self, context: bpy.types.Context) -> surface.Surface:
        """The active object's mesh."""
        chosen_only = not self.whole and context.active_object.mode != "OBJECT"
        self._surface = surface.read(context.active_object.data, chosen_only=chosen_only)
        return self._surface

    def take(self, context: bpy.types.Context, mapped: SeamedMesh) -> None:
        """Write a map, and say what it is as Blender has it."""
        data = context.active_object.data
        verdict = atlas.certify(surface.write(data, self._surface, mapped))
        kind = "INFO" if verdict.injective else "WARNING"
        self.report({kind}, f"{self.bl_label}: {' '.join(verdict.summary().splitlines()[:3])}")


class QHM_OT_check(UvWorking):
    """Select the faces whose UVs are flipped, without area, or in islands that overlap; decided exactly."""

    bl_idname = "uv.qhm_check"
    bl_label = "Check UVs"

    def prepare(self, context: bpy.types.Context) -> Work:
        """Judge."""
        self.whole = True
        mesh = self.read(context).mesh
        surface.require_map(self._surface)
        return lambda heard: atlas.certify(mesh)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Select and tell."""
        lying = {k for pair in result.overlapping.tolist() for k in pair}
        lying |= {k for k, one in enumerate(result.islands) if one.injective and not one.bijective}
        wrong = [result.flipped, *(result.islands[k].triangles for k in sorted(lying))]
        wrong += [result.islands[k].triangles for k in result.mirrored.tolist()]
        count = surface.select_faces(context.active_object.data, self._surface, np.unique(np.concatenate(wrong)))
        sound = result.bijective and not lying and not result.mirrored.size
        text = " ".join(result.summary().splitlines()[:3])
        self.report({"INFO" if sound else "WARNING"}, f"Check UVs: {count} faces selected. {text}")


class QHM_OT_repair(UvWorking):
    """Right flipped faces; borders stay, and so does every UV that need not move."""

    bl_idname = "uv.qhm_repair"
    bl_label = "Repair UVs"
    unmirror: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Turn mirrored islands over", description="Otherwise they are left, as some are on purpose", default=False
    )

    def prepare(self, context: bpy.types.Context) -> Work:
        """Repair."""
        mesh = self.read(context).mesh
        surface.require_map(self._surface)
        unmirror = self.unmirror
        return lambda heard: repair(mesh.V, mesh.F, mesh.uv, FT=mesh.FT, unmirror=unmirror, callback=heard)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write and tell."""
        mesh = self._surface.mesh
        surface.write(context.active_object.data, self._surface, SeamedMesh(mesh.V, mesh.F, result.FT, result.uv))
        self.report({"INFO" if result.injective else "WARNING"}, f"Repair UVs: {result.summary().splitlines()[0]}")


class QHM_OT_flatten(UvWorking):
    """Lay the surface flat, borders free, without flips or overlap; cut at marked seams, or where the UVs are."""

    bl_idname = "uv.qhm_flatten"
    bl_label = "Flatten"
    cut: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Find seams", description="Cut where the surface does not lie flat well", default=False
    )
    pack: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Pack", description="Lay islands into the unit square, all at one texel density", default=True
    )
    energy: bpy.props.EnumProperty(name="Keep", items=_ENERGIES)  # type: ignore[valid-type]

    def prepare(self, context: bpy.types.Context) -> Work:
        """Cut and flatten."""
        self.whole = True
        mesh, polygons = self.read(context).mesh, self._surface.polygons
        seams = surface.marked_seams(context.active_object.data)
        cut, pack, energy = self.cut, self.pack, self.energy

        def work(heard: Callable[[Step], None]) -> SeamedMesh:
            here = seaming.cut_along(mesh, seams, polygons=polygons) if len(seams) else mesh
            if cut:
                here = seaming.cut_apart(here, polygons=polygons)
            mapped = atlas.flatten(here, energy=energy, callback=heard)
            if mapped.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            return atlas.pack(mapped.mesh) if pack else mapped.mesh

        return work

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write and tell."""
        self.take(context, result)


class QHM_OT_reduce(UvWorking):
    """Reduce stretch with borders kept or free; no face flips on the way."""

    bl_idname = "uv.qhm_reduce_stretch"
    bl_label = "Reduce Stretch"
    free: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Free borders", description="Let borders go where stretch is least", default=False
    )
    energy: bpy.props.EnumProperty(name="Keep", items=_ENERGIES)  # type: ignore[valid-type]

    def prepare(self, context: bpy.types.Context) -> Work:
        """Polish."""
        mesh = self.read(context).mesh
        surface.require_map(self._surface)
        free, energy = self.free, self.energy

        def work(heard: Callable[[Step], None]) -> SeamedMesh:
            mapped = atlas.polish(mesh, free=free, energy=energy, callback=heard)
            if mapped.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            return mapped.mesh

        return work

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write and tell."""
        self.take(context, result)


class QHM_OT_fit(UvWorking):
    """Fit an island to an outline: a rectangle, a disk, a letter, or a curve of the scene."""

    bl_idname = "uv.qhm_fit"
    bl_label = "Fit to Outline"
    to: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Outline",
        items=[
            ("RECTANGLE", "Rectangle", "The unit square's width, with the height below"),
            ("DISK", "Disk", "A disk in the unit square"),
            ("LETTER", "Letter", "A letter in Blender's own font"),
            ("CURVE", "Curve", "A closed curve, text or flat mesh of the scene, seen from above"),
        ],
    )
    height: bpy.props.FloatProperty(name="Height", default=1.0, min=0.01, max=100.0)  # type: ignore[valid-type]
    letter: bpy.props.StringProperty(name="Letter", default="G", maxlen=1)  # type: ignore[valid-type]
    curve: bpy.props.StringProperty(name="Curve", description="Name of the object")  # type: ignore[valid-type]

    def prepare(self, context: bpy.types.Context) -> Work:
        """Lay the boundary along the outline, and map."""
        mesh = self.read(context).mesh
        if len(mesh.islands) != 1:
            raise Refused(f"There are {len(mesh.islands)} islands: select a face of the one to fit, in edit mode")
        contours = self._contours(context)

        def find(island: Island, heard: Callable[[Step], None]) -> MapResult:
            problem = laid_along(island.V, island.F, contours).problem
            result = solve(problem, callback=heard)
            if result.status is Status.INTERRUPTED:
                raise KeyboardInterrupt
            if not result.injective:
                reason = result.status.value if result.diagnosis is None else result.diagnosis.summary()
                raise Refused(f"no map without flips was found. {reason}")
            return polished(problem, result, energy="blend", max_iterations=20, callback=heard)

        return lambda heard: each_island(mesh, lambda island: find(island, heard), reflect=False).mesh

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write and tell."""
        self.take(context, result)

    def _contours(self, context: bpy.types.Context) -> list[Any]:
        """The outline in the unit square."""
        if self.to == "RECTANGLE":
            return targets.rectangle(1.0, self.height)
        if self.to == "DISK":
            found = targets.disk()
        elif self.to == "CURVE":
            thing = bpy.data.objects.get(self.curve)
            if thing is None:
                raise Refused(f"There is no object {self.curve!r}: name a curve of the scene")
            found = targets.nested(surface.contours(context, thing))
        else:
            found = targets.nested(self._letter(context))
        low = np.min([c.min(axis=0) for c in found], axis=0)
        size = float(np.max([c.max(axis=0) for c in found], axis=0).max() - low.min())
        size = float((np.max([c.max(axis=0) for c in found], axis=0) - low).max())
        return [(contour - low) / size for contour in found]

    def _letter(self, context: bpy.types.Context) -> list[Any]:
        if not self.letter.strip():
            raise Refused("Name a letter")
        text = bpy.data.curves.new("qhm letter", type="FONT")
        text.body = self.letter
        thing = bpy.data.objects.new("qhm letter", text)
        context.collection.objects.link(thing)
        try:
            context.view_layer.update()
            return surface.contours(context, thing)
        finally:
            bpy.data.objects.remove(thing)
            bpy.data.curves.remove(text)


CLASSES = (QHM_OT_check, QHM_OT_repair, QHM_OT_flatten, QHM_OT_reduce, QHM_OT_fit)
