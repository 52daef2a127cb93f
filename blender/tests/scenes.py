"""Objects to work on, and what is read off them again by other ways than the extension's own."""

import itertools
from pathlib import Path

import bpy
import numpy as np

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"


def add_mesh(V, faces, uv=None, name="thing"):
    """A mesh object, active and alone selected; ``uv`` has a place for every loop, or for every vertex."""
    data = bpy.data.meshes.new(name)
    data.from_pydata(np.asarray(V, dtype=float).tolist(), [], [list(map(int, face)) for face in faces])
    thing = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(thing)
    for other in bpy.context.selected_objects:
        other.select_set(False)
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing
    if uv is not None:
        data.uv_layers.new(name="UVMap")
        uv = np.asarray(uv)
        set_places(thing, uv if len(uv) == len(data.loops) else uv[vertices_of_loops(thing)])
    return thing


def add_scan():
    """A scan, cut into a disk, without UVs; a bumpy dome where there is no scan."""
    path = CASES / "flatten" / "bishop_part_f1000_2x.obj"
    if path.exists():
        return add_file(path)
    from quasiharmonic.surfaces import disk

    V, F = disk(10)
    x, y = V.T
    return add_mesh(np.column_stack([V, 2 * (1 - x**2 - y**2) + 0.2 * np.sin(7 * x) * np.cos(6 * y)]), F)


def add_file(path):
    """A mesh object of the `v`, `vt` and `f` lines of an OBJ file."""
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


def quads(n=6, height=0.3):
    """A hilly square of n by n quads: vertices (…, 3), the same seen from above (…, 2), faces (n², 4)."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.stack([first, first + 1, first + n + 2, first + n + 1], axis=1)
    flat = np.stack([x, y], axis=1) / n
    hills = height * np.sin(5 * flat[:, 0]) * np.cos(4 * flat[:, 1])
    return np.column_stack([flat, hills]), flat, faces


def add_quads(n=6):
    """A hilly square, its UVs as seen from above."""
    V, flat, faces = quads(n)
    return add_mesh(V, faces, flat)


def two_squares(shift, *, mirror=False):
    """Two squares of 4 by 4 quads, apart in space; the UVs of the second moved, or turned over."""
    V, flat, faces = quads(4)
    other = flat * [-1, 1] + [1, 0] if mirror else flat
    beside = V + np.array([2, 0, 0])
    both = np.concatenate([faces, faces + len(V)])
    return add_mesh(np.concatenate([V, beside]), both, np.concatenate([flat, other + shift]))


def vertices_of_loops(thing):
    found = np.empty(len(thing.data.loops), dtype=np.int32)
    thing.data.loops.foreach_get("vertex_index", found)
    return found


def places(thing, layer=None):
    """The UVs of every loop (l, 2), as Blender has them."""
    layer = thing.data.uv_layers.active if layer is None else thing.data.uv_layers[layer]
    found = np.empty(2 * len(thing.data.loops), dtype=np.float32)
    layer.uv.foreach_get("vector", found)
    return found.reshape(-1, 2)


def set_places(thing, uv):
    layer = thing.data.attributes[thing.data.uv_layers.active.name]
    layer.data.foreach_set("vector", np.asarray(uv, dtype=np.float32).ravel())


def move_vertex(thing, vertex, where):
    """Put all loops of a vertex somewhere."""
    uv = places(thing)
    uv[vertices_of_loops(thing) == vertex] = where
    set_places(thing, uv)


def triangles(thing):
    """Blender's own triangles by loops (f, 3), and the face of each (f,)."""
    thing.data.calc_loop_triangles()
    found = thing.data.loop_triangles
    return np.array([list(t.loops) for t in found]), np.array([t.polygon_index for t in found])


def verdict(thing):
    """The library's verdict on the UVs in single precision, as Blender has and draws them."""
    from quasiharmonic import atlas

    corners, _ = triangles(thing)
    V = np.array([v.co for v in thing.data.vertices])
    return atlas.certify(atlas.SeamedMesh(V, vertices_of_loops(thing)[corners], corners, places(thing)))


def stretch(thing):
    """Mean symmetric Dirichlet energy of the UVs, scaled to the surface's area; 4 for an isometry."""
    corners, _ = triangles(thing)
    V = np.array([v.co for v in thing.data.vertices], dtype=float)[vertices_of_loops(thing)[corners]]
    uv = places(thing).astype(float)[corners]
    along, across = V[:, 1] - V[:, 0], V[:, 2] - V[:, 0]
    length = np.linalg.norm(along, axis=1)
    area = np.linalg.norm(np.cross(along, across), axis=1) / 2
    zero = np.zeros_like(length)
    rest = np.stack([length, zero, (along * across).sum(axis=1) / length, 2 * area / length], axis=1).reshape(-1, 2, 2)
    images = np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], axis=1)
    images *= np.sqrt(area.sum() / np.abs(np.linalg.det(images)).sum() * 2)
    jacobian = np.linalg.solve(rest, images)
    inverse = np.linalg.inv(jacobian)
    return float((area * ((jacobian**2).sum(axis=(1, 2)) + (inverse**2).sum(axis=(1, 2)))).sum() / area.sum())


def unwrap(thing, **how):
    """Blender's own unwrap of all faces."""
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.uv.unwrap(**how)
    bpy.ops.object.mode_set(mode="OBJECT")


def border(thing):
    """Which loops are at vertices of the surface's border; (l,) bool."""
    sides = [tuple(sorted(key)) for face in thing.data.polygons for key in face.edge_keys]
    open_ = [side for side in set(sides) if sides.count(side) == 1]
    return np.isin(vertices_of_loops(thing), np.unique(open_))


def seams_of_map(thing):
    """Edges at which the UVs of two faces differ; a set of pairs of vertices."""
    uv, at = places(thing), {}
    for face in thing.data.polygons:
        loops = list(face.loop_indices)
        for a, b in itertools.pairwise([*loops, loops[0]]):
            ends = {thing.data.loops[k].vertex_index: tuple(uv[k]) for k in (a, b)}
            at.setdefault(tuple(sorted(ends)), []).append(sorted(ends.items()))
    return {side for side, found in at.items() if len(found) == 2 and found[0] != found[1]}


def selected(thing):
    """Which faces are selected; a set."""
    return {k for k, face in enumerate(thing.data.polygons) if face.select}


def everything_else(thing):
    """All of a mesh but its active UV layer and what is selected, as plain values to compare."""
    data = thing.data
    active = data.uv_layers.active
    return {
        "vertices": [tuple(v.co) for v in data.vertices],
        "edges": [(tuple(e.vertices), e.use_seam, e.use_edge_sharp) for e in data.edges],
        "faces": [(tuple(p.vertices), p.material_index, p.use_smooth) for p in data.polygons],
        "layers": {layer.name: places(thing, layer.name).tobytes() for layer in data.uv_layers if layer != active},
        "mine": [x.value for x in data.attributes["mine"].data] if "mine" in data.attributes else None,
        "groups": [[(g.group, g.weight) for g in v.groups] for v in data.vertices],
    }


def adorn(thing):
    """Give a mesh what artists' meshes have: another UV layer, an attribute, a group, materials, sharp edges."""
    data = thing.data
    active = data.uv_layers.active
    other = data.uv_layers.new(name="Other")
    other.uv.foreach_set("vector", np.linspace(0, 1, 2 * len(data.loops)).astype(np.float32))
    if active is None:
        data.uv_layers.remove(other)
    else:
        data.uv_layers.active = data.uv_layers["UVMap"]
    data.attributes.new("mine", "FLOAT", "POINT").data.foreach_set("value", np.arange(len(data.vertices)) * 0.5)
    thing.vertex_groups.new(name="group").add([0, 2], 0.25, "REPLACE")
    for name in ("one", "two"):
        data.materials.append(bpy.data.materials.new(name))
    data.polygons[1].material_index = 1
    data.polygons[2].use_smooth = True
    data.edges[3].use_edge_sharp = True
    return thing
