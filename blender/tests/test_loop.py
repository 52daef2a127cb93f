"""All operators one after another, with undo after each, many times: no crash, no leak, the same UVs again."""

import contextlib
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


def add_fins():
    """Suzanne with faces added at edges, repeated, reversed and degenerate, and a loose vertex."""
    bpy.ops.mesh.primitive_monkey_add()
    data = bpy.context.object.data
    V = np.array([v.co for v in data.vertices])
    faces = [list(face.vertices) for face in data.polygons]
    a, b = faces[10][:2]
    bpy.data.objects.remove(bpy.context.object)
    faces[5] = faces[5][::-1]
    further = [faces[0][::-1], [a, b, len(V)], [b, a, len(V) + 1], [a, b, len(V) + 2]]
    return scenes.add_mesh(np.concatenate([V, V[:3] * 1.5, [[5, 5, 5]]]), faces + further, name="fins")


def add_soup():
    """Quads that share positions but no vertices, some mirrored, with UVs of which some are inverted."""
    V, flat, faces = scenes.quads(4)
    corners = np.array(faces).ravel()
    rows = np.arange(len(corners)).reshape(-1, 4)
    uv = flat[corners]
    uv[:4] = uv[3::-1]
    return scenes.add_mesh(V[corners], [*rows[::2].tolist(), *rows[1::2, ::-1].tolist()], uv, name="soup")


@pytest.mark.parametrize("make", [add_fins, add_soup])
def test_every_operator_on_dirty_models_with_undo(make, said):
    """An operator may refuse such a model; it then changes nothing."""
    thing = make()
    name, done = thing.name, []
    assert bpy.ops.uv.qhm_unwrap() == {"FINISHED"}
    before = state(name)
    for act, options in [*ALL, ("unwrap", {"hard_edges": True, "symmetry": "x", "tiles": 2})]:
        bpy.ops.ed.undo_push(message="before")
        with contextlib.suppress(RuntimeError):
            done += [act] if getattr(bpy.ops.uv, f"qhm_{act}")(**options) == {"FINISHED"} else []
        if done[-1:] != [act]:
            assert "internal error" not in said()
            assert state(name) == before
            continue
        bpy.ops.ed.undo_push(message="after")
        bpy.ops.ed.undo()
        if bpy.context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        assert state(name) == before
    assert {"check", "repair", "unwrap", "reduce_stretch"} <= set(done)
