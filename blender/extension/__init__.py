"""Blender extension for UV maps without inverted faces: check, repair, unwrap, flatten, reduce stretch, fit."""

from __future__ import annotations

import bpy

from . import operators, panel, unwrap_operator

_CLASSES = (*operators.CLASSES, unwrap_operator.QHM_OT_unwrap, *panel.CLASSES)


def register() -> None:
    """Register the classes; Blender calls this when the extension is enabled."""
    for one in _CLASSES:
        bpy.utils.register_class(one)
    panel.add_entries()


def unregister() -> None:
    """Unregister the classes; Blender calls this when the extension is disabled."""
    panel.remove_entries()
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
