"""The operator that unwraps any model."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from quasiharmonic.apps.unwrapping.result import UnwrapResult
from quasiharmonic.apps.unwrapping.symmetry import describe_symmetry
from quasiharmonic.util.arrays import count_of
from quasiharmonic.util.options import SYMMETRIES

from . import unwrapping
from .job import Work, Working, list_names


class QHM_OT_unwrap(Working):
    """Unwrap any model: cut it into few parts with little stretch, mark the seams and pack one texture.

    In object mode all selected objects are unwrapped, in edit mode the selected faces.
    """

    bl_idname = "uv.qhm_unwrap"
    bl_label = "Unwrap Model"
    max_stretch: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Max Stretch",
        description="99 % of the surface are stretched or shrunk by at most this factor. Lower values need more seams",
        default=1.5,
        min=1.0,
        soft_min=1.05,
        soft_max=3.0,
    )
    max_charts: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Max Islands", description="Maximum number of islands; 0 for no limit", default=0, min=0
    )
    resolution: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Resolution",
        description="Side of the texture in texels, for the padding",
        default=2048,
        min=16,
        max=65536,
    )
    padding: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Padding", description="Minimum distance of two islands in texels", default=4.0, min=0.0, soft_max=64.0
    )
    tiles: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="UDIM Tiles", description="Number of tiles to fill, from 1001 on", default=1, min=1, soft_max=20
    )
    texels_per_unit: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Texel Density", description="Texels per unit of length; 0 for as many as fit", default=0.0, min=0.0
    )
    symmetry: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Symmetry",
        description="Mirror seams and islands in the middle plane normal to an axis of the object",
        items=[(axis, axis.title(), "") for axis in ("none", *SYMMETRIES[1:])],
    )
    hard_edges: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Sharp Edges", description="Edges marked as sharp become seams, as normal maps need them", default=False
    )
    around: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Around Others",
        description="Place new islands into free space of the texture, beside faces that are not unwrapped",
        default=False,
    )
    rotate: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Rotate", description="Rotate islands to fit better", default=True
    )
    stack: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Stack", description="Identical and mirrored parts share their place in the texture", default=False
    )
    keep_seams: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Keep Seams",
        description="Cut at the marked seams, or without any along the borders of the UVs, and further where needed",
        default=False,
    )
    mark_seams: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Mark Seams", description="Mark the new seams, and unmark other edges of these faces", default=True
    )

    def prepare(self, context: bpy.types.Context) -> Work:
        """Return the work that unwraps the objects."""
        self._objects = self.find_objects(context)
        self._parts = parts = unwrapping.read_parts(self._objects, edited=self.mode == "EDIT")
        # Islands with pinned UVs are not unwrapped, so the new ones must not lie over them.
        self._around = (self.around or any(part.pinned.any() for part in parts)) and not all(
            part.chosen.all() for part in parts
        )
        options = {
            "around": self._around,
            "hard_edges": self.hard_edges,
            "tiles": self.tiles,
            "texels_per_unit": self.texels_per_unit or None,
            "symmetry": None if self.symmetry == "none" else self.symmetry,
            "max_stretch": self.max_stretch,
            "max_charts": self.max_charts or None,
            "resolution": self.resolution,
            "padding": self.padding,
            "rotate": self.rotate,
            "stack": self.stack,
            "keep_seams": self.keep_seams,
        }
        return lambda reports_progress: unwrapping.unwrap_parts(parts, callback=reports_progress, **options)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        """Write the texture coordinates and report them."""
        crossed = unwrapping.write_parts(self._parts, result, around=self._around, mark_seams=self.mark_seams)
        sound = result.success and not result.misses and not crossed
        said = describe_unwrap(result, crossed) + unwrapping.describe_others(self._parts)
        self.report({"INFO" if sound else "WARNING"}, f"{self.bl_label}: {said}")
        changes = ", ".join(f"{name}: {len(found)}" for name, found in result.cleaned.changes.items() if len(found))
        if changes:
            self.report({"INFO"}, f"{self.bl_label}: the mesh is unchanged, but was treated as if cleaned. {changes}")
        inward = int(np.count_nonzero(result.cleaned.facing < 0))
        if inward:
            said = f"{count_of('closed part is', 'closed parts are', inward)} inside out: use Recalculate Outside"
            self.report({"WARNING"}, f"{self.bl_label}: {said}")
        if any(part.pinned.any() for part in self._parts):
            self.report({"INFO"}, f"{self.bl_label}: islands with pinned UVs stay as they are")
        if self.symmetry != "none":
            found = result.symmetry
            reason = found.reason or "seams are kept" * self.keep_seams
            said = f"the symmetry in {self.symmetry} was not applied{reason and ': '}{reason}"
            for line in describe_symmetry(found) or [said]:
                self.report({"INFO" if found.applied else "WARNING"}, f"{self.bl_label}: {line}")
        changed = [thing.name for thing in self._objects if thing.modifiers]
        if changed:
            said = f"the modifiers of {list_names(changed)} are ignored, the base mesh was unwrapped"
            self.report({"INFO"}, f"{self.bl_label}: {said}")


def describe_unwrap(result: UnwrapResult, crossed: int) -> str:
    """Return islands, stretch, use of the texture and the verdict in one line."""
    stretch = result.stretch
    said = (
        f"{count_of('island', 'islands', result.n_charts)}, stretch {stretch.p99:.2f} at 99 % of the surface and "
        f"{stretch.worst:.2f} at most, {100 * result.utilisation:.0f} % of the texture used. {result.message}"
    )
    if crossed:
        faces = count_of("face is", "faces are", crossed)
        said += f" But {faces} crossed by seams, so their UVs may overlap: triangulate them."
    return said
