"""UVs without flips, in Blender: checked exactly, repaired, flattened, smoothed, fitted to an outline."""

from __future__ import annotations

import bpy

from . import operators, panel

_CLASSES = (*operators.CLASSES, *panel.CLASSES)


def register() -> None:
    """Called by Blender when the extension is enabled."""
    for one in _CLASSES:
        bpy.utils.register_class(one)


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
