"""All operators one after another, with undo after each, many times: no crash, no leak, the same UVs again."""

import gc
from pathlib import Path

import bpy
import numpy as np
import pytest
import scenes

# Operators and their options.
ALL = [
    ("check", {}),
    ("repair", {}),
    ("unwrap", {}),
    ("unwrap", {"keep_seams": True, "max_stretch": 1.2}),
    ("flatten", {"energy": "blend"}),
    ("flatten", {"cut": True, "energy": "mips"}),
    ("reduce_stretch", {}),
    ("reduce_stretch", {"free": True}),
    ("fit", {"to": "DISK"}),
]
# Growth of the resident memory after the first rounds that counts as a leak.
_LEAK = 64 * 2**20


def resident():
    """Resident memory of this process in bytes."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * 4096


def state(name):
    """UVs to the last bit, and marked seams."""
    data = bpy.data.objects[name].data
    layers = {layer.name: scenes.places(bpy.data.objects[name], layer.name).tobytes() for layer in data.uv_layers}
    return layers, [edge.use_seam for edge in data.edges]


def select_one_island(name):
    """Edit the object with a single face selected, as for Fit."""
    thing = bpy.data.objects[name]
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.context.tool_settings.mesh_select_mode = (False, False, True)
    thing.data.polygons[0].select = True
    bpy.ops.object.mode_set(mode="EDIT")


def one_round(name):
    """Run and undo every operator; yield its name, and the state after it and after undoing it."""
    for act, options in ALL:
        if act == "fit":
            select_one_island(name)
        bpy.ops.ed.undo_push(message="before")
        mode = bpy.context.mode
        assert getattr(bpy.ops.uv, f"qhm_{act}")(**options) == {"FINISHED"}
        bpy.ops.ed.undo_push(message="after")
        if mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        after = state(name)
        if mode != "OBJECT":
            bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.ed.undo()
        if bpy.context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        yield act, after, state(name)


@pytest.mark.parametrize(("levels", "rounds"), [(0, 2), pytest.param(2, 20, marks=pytest.mark.nightly)])
def test_every_operator_and_undo(levels, rounds):
    bpy.ops.mesh.primitive_monkey_add()
    thing = bpy.context.object
    name = thing.name
    if levels:
        thing.modifiers.new("finer", "SUBSURF").levels = levels
        bpy.ops.object.modifier_apply(modifier="finer")
    # A bijective map with several islands to start from.
    assert bpy.ops.uv.qhm_flatten(cut=True) == {"FINISHED"}
    before = state(name)
    results, memory = {}, []
    for _ in range(rounds):
        for k, (act, after, undone) in enumerate(one_round(name)):
            assert undone == before
            assert (after == before) == (act in {"check", "repair"})
            # The same mesh gives the same result in every round.
            assert results.setdefault(k, after) == after
        gc.collect()
        memory.append(resident())
    # The first quarter fills caches and the stack of undo steps.
    assert memory[-1] - memory[len(memory) // 4] < _LEAK, np.round(np.array(memory) / 2**20).tolist()
