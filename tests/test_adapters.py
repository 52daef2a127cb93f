"""Meshes in every accepted form: objects of other libraries, files, results in place of maps, tensors."""

from __future__ import annotations

import inspect
import pickle
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import quasiharmonic
from quasiharmonic import (
    InverseMap,
    MovingMesh,
    Problem,
    atlas,
    boundary_loops,
    certify,
    cut_open,
    distortion,
    find_cuts,
    flatten,
    harmonise,
    injective_map,
    inverted_triangles,
    io,
    is_injective,
    keep_distances,
    morph,
    plot,
    polish,
    refine,
    repair,
    targets,
)
from quasiharmonic.apps.flattening.patterns import pattern
from quasiharmonic.apps.gradients.layers import LayerFunctions
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.energies.distances import surface_distances
from quasiharmonic.io import MeshData, MeshFileError
from quasiharmonic.io.objects import mesh_arrays
from quasiharmonic.surfaces import annulus, disk, grid

Pair = namedtuple("Pair", ["V", "F"])
PLANE, F = disk(3)
V = np.column_stack([PLANE, PLANE[:, 0] * PLANE[:, 1]])
(LOOP,) = boundary_loops(F, len(V))
# Like `quasiharmonic.torch` and `quasiharmonic.jax`, without their packages.
LAYERS = LayerFunctions(lambda make, settings, arguments: make(*settings))
BEAN = PLANE[LOOP] * (1 + 0.3 * PLANE[LOOP, :1])


def as_obj(points, faces):
    """Return the text of an OBJ file with unrounded numbers."""
    rows = [" ".join(["v", *map(repr, row)]) for row in np.asarray(points).tolist()]
    rows += [
        " ".join(["f", *(str(corner + 1) for corner in face)]) for face in np.asarray(faces, dtype=object).tolist()
    ]
    return "\n".join(rows) + "\n"


def padded(faces):
    """Return VTK's list: count, corners, count, …"""
    return np.concatenate([[len(face), *face] for face in faces])


def block(kind, rows):
    return SimpleNamespace(type=kind, data=rows)


# Objects as each library defines them; cells that are no faces are ignored.
STAND_INS = {
    "trimesh": SimpleNamespace(vertices=V, faces=F, triangles=V[F]),
    "open3d": SimpleNamespace(vertices=V.tolist(), triangles=F.astype(np.int32)),
    "pyvista": SimpleNamespace(points=V, faces=padded(F), verts=np.empty(0, int), strips=np.empty(0, int)),
    "grid of pyvista": SimpleNamespace(
        points=V, cells=padded([[0], *F, [0, 1]]), celltypes=np.array([1, *[5] * len(F), 3])
    ),
    "meshio": SimpleNamespace(
        points=V, cells=[block("line", [[0, 1]]), block("triangle", F[:5]), block("triangle", F[5:])]
    ),
    "vedo": SimpleNamespace(vertices=V, cells=F.tolist()),
    "scipy": SimpleNamespace(points=PLANE, simplices=F),
    "nilearn": SimpleNamespace(coordinates=V, faces=F),
    "mapping": {"vertices": V, "triangles": F},
    "named pair": Pair(V, F),
    "MeshData": MeshData(V, F),
    "SeamedMesh": SeamedMesh(V, F),
}


@pytest.mark.parametrize("name", STAND_INS)
def test_attribute_names_of_every_library(name):
    taken, triangles = mesh_arrays(STAND_INS[name])
    np.testing.assert_array_equal(taken, PLANE if name == "scipy" else V)
    np.testing.assert_array_equal(triangles, F)


def test_larger_faces_are_triangulated_as_in_files(tmp_path):
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0], [2.5, 0.5, 0], [2, 1, 0.0]])
    faces = [[0, 1, 2, 3], [1, 4, 5, 6, 2]]
    (tmp_path / "faces.obj").write_text(as_obj(points, faces))
    wanted = mesh_arrays(tmp_path / "faces.obj")[1]
    assert len(wanted) == 5
    for mesh in (
        SimpleNamespace(points=points, faces=padded(faces)),
        SimpleNamespace(points=points, cells=[block("quad", faces[:1]), block("polygon", faces[1:])]),
        SimpleNamespace(vertices=points, cells=faces),
    ):
        np.testing.assert_array_equal(mesh_arrays(mesh)[1], wanted)
    quads = SimpleNamespace(vertices=points[:4], faces=np.array([[0, 1, 2, 3]]))
    assert len(mesh_arrays(quads)[1]) == 2
    assert mesh_arrays(SimpleNamespace(points=points[:4, :2], faces=padded(faces[:1])))[1].shape == (2, 3)


MESH = STAND_INS["trimesh"]
MAP = injective_map(V, F, LOOP, BEAN)
# Every public function of V and F, with its other arguments.
CALLS = {
    "Problem": (Problem, (LOOP, BEAN), {}),
    "InverseMap": (InverseMap, (MAP,), {}),
    "injective_map": (injective_map, (LOOP, BEAN), {}),
    "polish": (polish, (MAP,), {"fixed": LOOP, "max_iterations": 2}),
    "harmonise": (harmonise, (MAP,), {"fixed": LOOP, "max_iterations": 2}),
    "flatten": (flatten, (), {"max_iterations": 2}),
    "keep_distances": (keep_distances, (MAP,), {"max_iterations": 2}),
    "distortion": (distortion, (MAP,), {}),
    "repair": (repair, (MAP,), {}),
    "find_cuts": (find_cuts, (), {}),
    "cut_open": (cut_open, (), {}),
    "refine": (refine, ([F[0, :2]],), {"boundary": True}),
    "boundary_to": (targets.boundary_to, ("rect:2x1",), {}),
    "boundary_turning": (targets.boundary_turning, (), {}),
    "boundary_corners": (targets.boundary_corners, (4,), {}),
    "nearest_on_boundary": (targets.nearest_on_boundary, (V[LOOP[:2]],), {}),
    "surface_distances": (surface_distances, (), {"rings": 2}),
}


def state(value):
    """Return the contents of a result as bytes, without times."""
    plain = {k: v for k, v in vars(value).items() if k not in ("seconds", "stages")} if hasattr(value, "uv") else value
    return plain if isinstance(plain, bytes) else pickle.dumps(plain)


@pytest.mark.parametrize("name", CALLS)
def test_one_mesh_in_place_of_v_and_f(name, tmp_path):
    function, rest, options = CALLS[name]
    (tmp_path / "mesh.obj").write_text(as_obj(V, F))
    wanted = state(function(V, F, *rest, **options))
    for mesh in (MESH, tmp_path / "mesh.obj", str(tmp_path / "mesh.obj")):
        assert state(function(mesh, *rest, **options)) == wanted
    assert state(function(*rest, V=V, F=F, **options) if not rest else function(V, F, *rest, **options)) == wanted
    with pytest.raises(TypeError, match="a SimpleNamespace provides both V and F: omit F"):
        function(MESH, F, *rest, **options)
    with pytest.raises(TypeError, match="provides both V and F"):
        function(MESH, *rest, F=F, **options)
    assert list(inspect.signature(function).parameters)[:2] == ["V", "F"]
    assert "or a mesh in place of ``V`` and ``F``" in inspect.getdoc(function)


def test_all_public_functions_of_v_and_f_are_tested():
    """Every public function that begins with V and F accepts a mesh."""
    rooms = (quasiharmonic, targets, plot)
    found = set()
    for name, function in ((name, getattr(room, name)) for room in rooms for name in room.__all__):
        # Exceptions and modules have no parameters of their own.
        if inspect.ismodule(function) or (inspect.isclass(function) and issubclass(function, Exception)):
            continue
        parameters = [p for p in inspect.signature(function).parameters if p != "path"]
        # These return a mesh, and do not take one.
        if parameters[:2] == ["V", "F"] and name not in ("CutMesh", "Refined"):
            found.add(name)
            assert hasattr(function, "__wrapped__") or hasattr(function.__init__, "__wrapped__"), name
    assert set(CALLS) - {"surface_distances"} <= found


@pytest.mark.slow
def test_pictures_of_meshes(tmp_path):
    for number, given in enumerate(((V, F), (MESH,))):
        plot.save_map_figure(tmp_path / f"{number}.png", *given, MAP)
    assert (tmp_path / "0.png").read_bytes() == (tmp_path / "1.png").read_bytes()


def test_triangles_alone():
    for given in (MESH, STAND_INS["meshio"]):
        assert certify(given, MAP).bijective
        assert is_injective(given, MAP)
        assert not inverted_triangles(given, MAP).size
        assert len(pattern(given, MAP).seam) == 1
        assert not len(targets.flattened_edges(given, LOOP, BEAN))


def test_planar_meshes_are_moved():
    points, triangles = grid(4, 4)
    upper = np.flatnonzero(points[:, 1] == 1)
    to = points[upper] * [1, 0.8]
    wanted = morph(points, triangles, upper, to).points
    flat = SimpleNamespace(
        points=np.column_stack([points, np.full(len(points), 3.0)]), cells=[block("triangle", triangles)]
    )
    np.testing.assert_array_equal(morph(flat, upper, to).points, wanted)
    np.testing.assert_array_equal(morph(points=flat, moved_vertices=upper, target=to).points, wanted)
    with pytest.raises(ValueError, match=r"points must have shape \(n, 2\)"):
        morph(MESH, upper, to)


def test_atlases_of_files_and_objects(tmp_path):
    mapped = SeamedMesh(V, F, F, MAP.uv)
    io.write_mapped(tmp_path / "map.obj", MeshData(V, F).with_places(mapped))
    wanted = atlas.polish(mapped, max_iterations=2).mesh.uv
    for given in (tmp_path / "map.obj", MeshData(V, F).with_map(MAP.uv)):
        np.testing.assert_array_equal(atlas.polish(given, max_iterations=2).mesh.uv, wanted)
        assert atlas.certify(given).bijective
    assert len(atlas.flatten(MESH, max_iterations=1).islands) == 1
    with pytest.raises(TypeError, match="a list is not a mesh: pass a SeamedMesh"):
        atlas.certify([V, F])


def test_outlines_by_name():
    whole = targets.boundary_to(V, F, targets.filled(targets.outline("letter:R")))
    named = targets.boundary_to(V, F, "letter:R")
    np.testing.assert_array_equal(named[1], whole[1])
    ring, triangles = annulus(6)
    fixed, target = targets.boundary_to(ring, triangles, "ring:0.4")
    assert injective_map(ring, triangles, fixed, target).injective
    rows = targets.boundary_to(V, F, [[0, 0], [2, 0], [2, 1], [0, 1]])
    np.testing.assert_array_equal(rows[1], targets.boundary_to(V, F, "rect:2x1")[1])


class Tensor:
    """Like PyTorch's tensors, whose numbers NumPy reads only on the CPU and without gradients."""

    def __init__(self, values, *, requires_grad=False, device="cpu"):
        self.values, self.requires_grad, self.device = values, requires_grad, device

    def __array__(self, dtype=None, copy=None):
        if self.requires_grad:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")
        if self.device != "cpu":
            raise TypeError("can't convert device type tensor to numpy.")
        return np.asarray(self.values, dtype=dtype)

    def __len__(self):
        return len(self.values)

    def cpu(self):
        return Tensor(self.values)


class Capsule:
    """An object that offers its memory by DLPack alone."""

    def __init__(self, values):
        self.values = values

    def __dlpack__(self, **how):
        return self.values.__dlpack__(**how)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


@pytest.mark.parametrize("wrap", [Tensor, Capsule])
def test_arrays_of_other_libraries(wrap):
    result = injective_map(wrap(V), wrap(F), wrap(LOOP), wrap(BEAN))
    np.testing.assert_array_equal(result.uv, MAP.uv)
    assert certify(wrap(F), wrap(MAP.uv)).bijective
    assert distortion(wrap(V), wrap(F), wrap(MAP.uv)).sigma1.tolist() == distortion(V, F, MAP).sigma1.tolist()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: distortion(Tensor(V, requires_grad=True), F, MAP), r"V is a Tensor that requires grad.*V\.detach\(\)"),
        (lambda: distortion(V, F, Tensor(MAP.uv, device="cuda:0")), r"uv is a Tensor on cuda:0: pass uv\.cpu\(\)"),
        (lambda: distortion(V, F, MESH), "uv must contain real numbers, not a SimpleNamespace"),
        (lambda: distortion(V, MESH, MAP), "F must contain integer indices, not a SimpleNamespace"),
        (lambda: distortion(V, F, "map.obj"), "uv must contain real numbers, not 'map.obj'"),
        (lambda: distortion(None, F, MAP), "V must contain real numbers, not None"),
        (lambda: distortion([[0, None]], F, MAP), "V must contain real numbers, not objects, the first of them 0"),
        (
            lambda: distortion((V[:, :2], F), MAP),
            r"V is a tuple of 2 arrays: pass them as separate arguments, as in distortion\(",
        ),
        (lambda: flatten(SimpleNamespace(geometry={})), "a SimpleNamespace is not a mesh, because it has no vertices"),
        (lambda: flatten({"vertices": V}), "a dict is not a mesh, because it has no faces"),
        (lambda: flatten(SimpleNamespace(vertices=V, faces=[0, 1, 2])), "faces of a SimpleNamespace must have one row"),
        (lambda: flatten(SimpleNamespace(points=V, cells=[block("tetra", F)])), "cells of type 'tetra'"),
        (lambda: flatten(SimpleNamespace(points=V, simplices=F[:, [0, 1, 2, 0]])), "simplices .* are tetrahedra"),
        (lambda: flatten(SimpleNamespace(points=V, cells=padded(F), celltypes=[10] * len(F))), "VTK type 10"),
        (
            lambda: flatten(SimpleNamespace(points=V, faces=padded(F[1:]), strips=padded(F[:1]))),
            r"a SimpleNamespace has triangle strips: pass mesh\.triangulate\(\)",
        ),
        (lambda: flatten(SimpleNamespace(points=V, faces=padded(F + 99))), "the faces refers? to vert"),
        (lambda: flatten(V, F + 1), rf"vertex {len(V)}, but .*; if its indices count from 1, pass F - 1"),
        (
            lambda: quasiharmonic.injective_map(V, F, np.ones(len(V), dtype=bool), MAP.uv),
            r"fixed must contain integer indices, not bool: pass numpy\.flatnonzero\(fixed\)",
        ),
        (lambda: quasiharmonic.solve(MAP), "solve takes a Problem, not a MapResult"),
        (lambda: LAYERS.injective_map(V), "injective_map takes a Problem, not a ndarray"),
        (lambda: LAYERS.quasi_harmonic_map((V, F)), "quasi_harmonic_map takes a Problem, not a tuple"),
        (lambda: targets.boundary_to(V, F, 3), 'outline must be contours .* "letter:R", not 3'),
        (lambda: targets.boundary_to(V, F, "letter"), "unknown outline 'letter'"),
        (lambda: targets.boundary_to(V, F, [["a", "b"]] * 3), "must contain real numbers, not <U1"),
    ],
)
def test_ambiguous_arguments_are_named(call, message):
    with pytest.raises((ValueError, TypeError), match=message):
        call()


def test_files_that_are_not_meshes():
    with pytest.raises(MeshFileError, match=r"nowhere\.obj"):
        flatten(Path("nowhere.obj"))
    with pytest.raises(MeshFileError, match="no suffix, so its format is unknown"):
        flatten("mesh")


@pytest.mark.parametrize(
    "call",
    [
        lambda: injective_map(F, V, LOOP, BEAN),
        lambda: distortion(F, V, MAP),
        lambda: certify(V, F),
        lambda: injective_map(V, F, BEAN, LOOP),
    ],
)
def test_arguments_in_another_order(call):
    with pytest.raises(ValueError, match="not float64; check the order of the arguments: these may be positions"):
        call()


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("scaled", lambda no: harmonise(V, F, MAP, fixed=LOOP, scaled=no)),
        ("refine", lambda no: injective_map(V, F, LOOP, BEAN, refine=no)),
        ("boundary", lambda no: certify(F, MAP, boundary=no)),
        ("boundary", lambda no: refine(V, F, [[0, 1]], boundary=no)),
        ("whole", lambda no: repair(V, F, MAP.uv, whole=no)),
        ("unmirror", lambda no: repair(V, F, MAP.uv, unmirror=no)),
        ("unit_square", lambda no: flatten(V, F, unit_square=no)),
        ("overlapping", lambda no: InverseMap(V, F, MAP, overlapping=no)),
    ],
)
def test_strings_are_no_booleans(name, call):
    with pytest.raises(ValueError, match=f"{name} must be True or False, not 'no'"):
        call("no")


@pytest.mark.slow
def test_trimesh():
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.Trimesh(V, F, process=False)
    assert distortion(mesh, injective_map(mesh, LOOP, BEAN)).inverted.size == 0
    with pytest.raises(ValueError, match="a Scene is not a mesh"):
        flatten(trimesh.Scene([mesh]))
    with pytest.raises(ValueError, match="a Scene is not a mesh"):
        MovingMesh(trimesh.Scene([mesh]))
    with pytest.raises(ValueError, match=r"a PointCloud is not a mesh, .* no faces"):
        flatten(trimesh.PointCloud(V))


def test_meshlane():
    meshlane = pytest.importorskip("meshlane")
    points, triangles = grid(3, 3)
    mesh = meshlane.Mesh(points, [("line", [[0, 1]]), ("triangle", triangles)])
    np.testing.assert_array_equal(mesh_arrays(mesh)[1], triangles)


def test_pyvista():
    pyvista = pytest.importorskip("pyvista")
    mesh = pyvista.PolyData.from_regular_faces(V, F)
    for given in (mesh, mesh.cast_to_unstructured_grid()):
        np.testing.assert_array_equal(injective_map(given, LOOP, BEAN).uv, MAP.uv)
    with pytest.raises(ValueError, match=r"an ImageData is not a mesh, .* no faces"):
        flatten(pyvista.ImageData(dimensions=(3, 3, 1)))
