"""Panels with the operators' buttons, in the sidebars of the UV editor and of the 3D view."""

from __future__ import annotations

from typing import Any

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
# Menus with the entry, and the keymaps with the shortcut Ctrl-Shift-U.
_MENUS = "VIEW3D_MT_uv_map", "IMAGE_MT_uvs"
_KEYMAPS = "Mesh", "UV Editor"
_keys: list[Any] = []


def _draw_entry(menu: Any, context: bpy.types.Context) -> None:
    menu.layout.separator()
    menu.layout.operator("uv.qhm_unwrap")


def add_entries() -> None:
    """Add Unwrap Model to the UV menus, and its shortcut."""
    for name in _MENUS:
        getattr(bpy.types, name).append(_draw_entry)
    # Without a window there are no keys.
    keys = bpy.context.window_manager.keyconfigs.addon
    for name in _KEYMAPS if keys else ():
        keymap = keys.keymaps.new(name=name)
        _keys.append((keymap, keymap.keymap_items.new("uv.qhm_unwrap", "U", "PRESS", ctrl=True, shift=True)))


def remove_entries() -> None:
    """Remove what `add_entries` added."""
    for name in _MENUS:
        getattr(bpy.types, name).remove(_draw_entry)
    for keymap, item in _keys:
        keymap.keymap_items.remove(item)
    _keys.clear()
