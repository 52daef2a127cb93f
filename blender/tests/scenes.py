"""Objects to work on, and what is read off them again by other ways than the extension's own."""

from pathlib import Path

import bpy
import numpy as np

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"


def add_mesh(V, faces, uv=None, name="thing"):
    """A mesh object, active and alone selected; ``uv`` has a place for every loop, or for every vertex."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(np.asarray(V, dtype=float).tolist(), [], [list(map(int, face)) for face in faces])
    if uv is not None:
        layer = data.uv_layers.new(name="UVMap")
        uv = np.asarray(uv)
        if len(uv) != len(data.loops):
            uv = uv[vertices_of_loops(data)]
        layer.uv.foreach_set("vector", uv.astype(np.float32).ravel())
    thing = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(thing)
    for other in bpy.context.selected_objects:
        other.select_set(False)
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing
    return thing


def add_suzanne():
    bpy.ops.mesh.primitive_monkey_add()
    return bpy.context.active_object


def add_file(path):
    """A mesh object of an OBJ file of `v`, `vt` and `f` lines; None if the file is not there."""
    if not path.exists():
        return None
    V, vt, faces, at = [], [], [], []
    for line in path.read_text().splitlines():
        word, *rest = line.split() or [""]
        if word == "v":
            V.append([float(x) for x in rest[:3]])
        elif word == "vt":
            vt.append([float(x) for x in rest[:2]])
        elif word == "f":
            corners = [corner.split("/") for corner in rest]
            faces.append([int(corner[0]) - 1 for corner in corners])
            at += [int(corner[1]) - 1 for corner in corners if len(corner) > 1 and corner[1]]
    return add_mesh(V, faces, np.array(vt)[at] if at else None, name=path.stem)


def vertices_of_loops(data):
    found = np.empty(len(data.loops), dtype=np.int32)
    data.loops.foreach_get("vertex_index", found)
    return found


def places(thing, layer=None):
    """The UVs of every loop (l, 2), as Blender has them."""
    layer = thing.data.uv_layers.active if layer is None else thing.data.uv_layers[layer]
    found = np.empty(2 * len(thing.data.loops), dtype=np.float32)
    layer.uv.foreach_get("vector", found)
    return found.reshape(-1, 2)


def triangles(thing):
    """Blender's own triangles: vertices (f, 3), loops (f, 3), and the face of each (f,)."""
    data = thing.data
    data.calc_loop_triangles()
    corners = np.array([list(t.loops) for t in data.loop_triangles])
    return vertices_of_loops(data)[corners], corners, np.array([t.polygon_index for t in data.loop_triangles])


def selected(thing):
    """Which faces are selected; a set."""
    return {k for k, face in enumerate(thing.data.polygons) if face.select}


def shape(thing):
    """All of a mesh but its active UV layer, to be compared; as plain values."""
    data = thing.data
    active = data.uv_layers.active
    return {
        "vertices": [tuple(v.co) for v in data.vertices],
        "edges": [(tuple(e.vertices), e.use_seam, e.use_edge_sharp) for e in data.edges],
        "faces": [(tuple(p.vertices), p.material_index, p.use_smooth) for p in data.polygons],
        "layers": {
            layer.name: places(thing, layer.name).tobytes()
            for layer in data.uv_layers
            if active is None or layer.name != active.name
        },
        "attributes": {
            a.name: [tuple(x.color) if a.data_type == "FLOAT_COLOR" else x.value for x in a.data]
            for a in data.attributes
            if a.name in {"mine", "colour"}
        },
        "groups": [[(g.group, g.weight) for g in v.groups] for v in data.vertices],
    }
