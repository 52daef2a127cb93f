"""Panels with the operators' buttons, in the sidebars of the UV editor and of the 3D view."""

from __future__ import annotations

import bpy

from . import operators


class _Buttons:
    bl_label = "Quasiharmonic"
    bl_region_type = "UI"
    bl_category = "Quasiharmonic"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the active object is a mesh."""
        return operators.QHM_OT_check.poll(context)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw one button per line, and two for operators with options."""
        column = self.layout.column(align=True)  # type: ignore[attr-defined]
        column.operator("uv.qhm_check")
        column.operator("uv.qhm_repair")
        column.separator()
        column.operator("uv.qhm_unwrap")
        column.separator()
        column.operator("uv.qhm_flatten").cut = False
        column.operator("uv.qhm_flatten", text="Cut and Flatten").cut = True
        column.separator()
        column.operator("uv.qhm_reduce_stretch").free = False
        column.operator("uv.qhm_reduce_stretch", text="Reduce Stretch, Borders Free").free = True
        column.separator()
        for to, text in (("RECTANGLE", "Fit to Rectangle"), ("DISK", "Fit to Disk"), ("LETTER", "Fit to Letter")):
            column.operator("uv.qhm_fit", text=text).to = to
        for thing in context.selected_objects:
            if thing.type in {"CURVE", "FONT"}:
                button = column.operator("uv.qhm_fit", text=f"Fit to {thing.name}")
                button.to, button.curve = "CURVE", thing.name


class QHM_PT_uv(_Buttons, bpy.types.Panel):
    """The panel of the UV editor."""

    bl_idname = "QHM_PT_uv"
    bl_space_type = "IMAGE_EDITOR"


class QHM_PT_view(_Buttons, bpy.types.Panel):
    """The panel of the 3D view."""

    bl_idname = "QHM_PT_view"
    bl_space_type = "VIEW_3D"


CLASSES = (QHM_PT_uv, QHM_PT_view)
