"""The command and the script of a studio page make the map that it shows, to the last bit, from the file as opened."""

from __future__ import annotations

import contextlib
import copy
import io as text_io
import shutil
from functools import cache

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.surfaces import annulus, cat, starfish
from quasiharmonic.ui.cli import main
from shared.gltf_files import touching_squares
from shared.pages import Visitor

SVG = b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10"><path d="M0 0 H10 V4 H4 V10 H0 Z"/></svg>'
POLYGON = np.array([[0, 0], [2, 0], [2, 1], [1, 0.4], [0, 1.0]]).ravel()


def two_parts():
    """Return a disk and a ring, as one model."""
    (V, F), (W, G) = cat(6), annulus(5)
    W = np.pad(W, [(0, 0), (0, 3 - W.shape[1])]) + 3.0
    return np.concatenate([V, W]), np.concatenate([F, G + len(V)])


def spoilt():
    """Return a star with a repeated, a reversed and a degenerate triangle, and a fin on one of its edges."""
    V, F = starfish(3, 6)
    F = F.copy()
    F[7] = F[7, ::-1]
    a, b = F[20, :2]
    V = np.concatenate([V, [(V[a] + V[b]) / 2 * 1.3]])
    return V, np.concatenate([F, F[:1], [[3, 3, 5]], [[a, b, len(V) - 1]]])


MODELS = {
    "disk": lambda: cat(8),
    "ring": lambda: annulus(6),
    "closed": lambda: starfish(3, 6),
    "two parts": two_parts,
    "spoilt": spoilt,
}


@pytest.fixture(scope="module")
def first_opened(tmp_path_factory):
    """Return a function that opens a model as a file, once."""

    @cache
    def open_model(name):
        V, F = MODELS[name]()
        path = tmp_path_factory.mktemp("models") / "model.obj"
        io.write_obj(path, io.MeshData(V, F))
        return path, Visitor(path)

    return open_model


@pytest.fixture
def opened(tmp_path, first_opened):
    """Return a function that opens a model as a file in an empty folder."""

    def open_model(name):
        path, one = first_opened(name)
        shutil.copyfile(path, tmp_path / path.name)
        return copy.deepcopy(one)

    return open_model


def corners_of(mesh):
    """Return the position of every corner in the plane."""
    return mesh.vt[mesh.FT] if isinstance(mesh, io.MeshData) else mesh.uv[mesh.FT]


def check_repeated(one, folder, monkeypatch, *, code=0):
    """Run command and script in a folder with the file as opened and the files that the page saves."""
    for name, content in one.files().items():
        if name != "map.obj":
            (folder / name).write_bytes(content)
    monkeypatch.chdir(folder)
    shown = one.last("map").header
    assert set(shown["needs"]) <= {path.name for path in folder.iterdir()}
    words = shown["command"].split()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with contextlib.redirect_stdout(text_io.StringIO()), contextlib.redirect_stderr(text_io.StringIO()):
        assert main(words[1:]) == code
        names = {}
        exec(shown["python"], names)
    assert all((folder / name).read_bytes() == content for name, content in before.items())
    state = one.session.state
    expected = corners_of(state.mesh)
    made, scripted = io.read_mesh(folder / words[-1]), names["mesh"]
    if len(made.F) != len(state.mesh.F):
        # The command wrote the model as it is in the file, the page maps its cleaned surface.
        assert words[1] == "unwrap"
        expected = corners_of(state.sheet.mapped_file(state.mesh))
    assert np.array_equal(corners_of(made), expected)
    assert np.array_equal(corners_of(scripted), expected)


STEPS = {
    "as it is": lambda one: None,
    "letter": lambda one: one.does("outline", to="letter:L"),
    "corner": lambda one: one.does("corner", vertex=int(one.session.state.islands[0].loops[0][5])),
    "by angle": lambda one: one.does("corners"),
    "svg": lambda one: one.does("drawing", {"content": np.frombuffer(SVG, np.uint8)}, name="an l.svg"),
    "polygon": lambda one: one.does("polygon", {"points": POLYGON}),
    "polish": lambda one: one.does("polish", energy="symmetric-dirichlet", slide=False),
    "slide": lambda one: one.does("polish", energy="mips", slide=True),
    "flatten": lambda one: one.does("flatten"),
    "unwrap": lambda one: one.does("unwrap", resolution=512),
    "pack": lambda one: one.does("pack"),
    "drag": lambda one: drag(one),
    "pinned": lambda one: [pin(one), drag(one)],
    "pinned flat": lambda one: [pin(one), one.does("flatten")],
    "pinned polish": lambda one: [pin(one), one.does("polish", energy="blend", slide=False)],
    "one of two": lambda one: [one.does("select", islands=[1]), one.does("flatten")],
    "one of two polished": lambda one: [
        one.does("select", islands=[0]),
        one.does("polish", energy="mips", slide=False),
    ],
    "one of two to a disk": lambda one: [one.does("select", islands=[0]), one.does("outline", to="disk")],
    "both to squares": lambda one: [one.does("select", islands=[]), one.does("outline", to="rect:1x1")],
    "one of two moved": lambda one: [one.does("select", islands=[0]), one.does("place", to=[0.3, -0.2], turn=15)],
    "seams drawn, flat": lambda one: [draw(one), one.does("flatten")],
    "seams drawn, unwrapped": lambda one: [draw(one), one.does("unwrap", resolution=512)],
    "seams erased": lambda one: [draw(one), one.does("erase", vertex=0), one.does("flatten")],
    "seams kept": lambda one: [one.does("flatten"), one.does("unwrap", resolution=512, keep_seams=True)],
    "turned": lambda one: one.does("turn"),
    "turned, unwrapped": lambda one: [one.does("turn"), one.does("unwrap", resolution=512)],
}


def drag(one):
    vertex = int(one.session.state.numbering.F[0, 0])
    state = one.session.state
    vertex = int(state.islands[0].loops[0][0])
    place = state.uv[vertex]
    size = 0.02 * np.ptp(state.uv, axis=0).max()
    one.drags(vertex, *((place + size * np.array([-k, 0.4 * k])).tolist() for k in range(1, 4)))


def pin(one):
    island = one.session.state.islands[0]
    inner = np.setdiff1d(np.arange(len(island.island.V)), np.concatenate(island.loops))
    one.does("pin", vertex=int(inner[len(inner) // 2]))


def draw(one):
    """Draw a seam between two vertices that are far apart."""
    V = one.session.state.numbering.V
    one.does("seam", start=int(np.argmin(V[:, 0])), vertex=int(np.argmax(V[:, 0])))
    assert one.last("map").header["drawn"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "step"),
    [
        *(("disk", step) for step in ("as it is", "letter", "corner", "by angle", "svg", "polygon", "polish", "slide")),
        *(("disk", step) for step in ("flatten", "unwrap", "drag", "pinned", "pinned flat", "pinned polish", "turned")),
        ("disk", "seams erased"),
        ("ring", "as it is"),
        *(("closed", step) for step in ("as it is", "seams drawn, flat", "pack", "seams kept", "turned, unwrapped")),
        *(("two parts", step) for step in ("as it is", "one of two", "one of two polished", "one of two to a disk")),
        ("two parts", "one of two moved"),
        ("spoilt", "as it is"),
        # The same steps with further models.
        *(pytest.param("ring", step, marks=pytest.mark.nightly) for step in ("drag", "polish")),
        *(
            pytest.param("closed", step, marks=pytest.mark.nightly)
            for step in ("unwrap", "letter", "drag", "seams drawn, unwrapped")
        ),
        *(
            pytest.param("two parts", step, marks=pytest.mark.nightly)
            for step in ("drag", "flatten", "pack", "polish", "unwrap")
        ),
        *(
            pytest.param("spoilt", step, marks=pytest.mark.nightly)
            for step in ("flatten", "polish", "drag", "turned, unwrapped")
        ),
    ],
)
def test_the_command_and_the_script_make_the_map_of_the_page(model, step, opened, tmp_path, monkeypatch):
    one = opened(model)
    STEPS[step](one)
    shown = one.last("map").header
    assert shown["injective"], shown["verdict"]
    check_repeated(one, tmp_path, monkeypatch)


def test_meshes_of_a_gltf_file_are_not_joined(tmp_path, monkeypatch):
    path = tmp_path / "model.glb"
    path.write_bytes(touching_squares().glb())
    one = Visitor(path)
    one.does("unwrap", resolution=512)
    assert one.last("map").header["count"] == 2
    check_repeated(one, tmp_path, monkeypatch)


@pytest.mark.slow
def test_a_map_with_inverted_triangles_is_made_again_too(opened, tmp_path, monkeypatch):
    """A point of the boundary goes across the opposite side, so that one island of two has no map."""
    one = opened("two parts")
    state = one.session.state
    loop = state.islands[0].loops[0]
    near = state.uv[loop[0]]
    far = state.uv[loop[np.argmax(np.linalg.norm(state.uv[loop] - near, axis=1))]]
    one.drags(int(loop[0]), (far + 0.5 * (far - near)).tolist())
    shown = one.last("map").header
    assert not shown["injective"]
    check_repeated(one, tmp_path, monkeypatch, code=1)
    for what in ("pack", "polish"):
        said = one.does(what, energy="mips")[-1].header["text"]
        assert said == "island 0 has inverted triangles: press Repair, or undo"


def test_the_final_map_does_not_depend_on_the_path_of_the_drag(opened):
    one, other = opened("disk"), opened("disk")
    vertex = one.session.state.corners[2]
    one.drags(vertex, (1.2, 0.7))
    other.drags(vertex, (1.3, 1.3), (0.9, 1.4), (1.0, 0.9), (1.2, 0.7))
    assert np.array_equal(one.session.state.uv, other.session.state.uv)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "form"),
    [
        ("closed", "obj"),
        ("spoilt", "glb"),
        ("two parts", "ply"),
        *(pytest.param("closed", form, marks=pytest.mark.nightly) for form in ("glb", "ply")),
        *(pytest.param("spoilt", form, marks=pytest.mark.nightly) for form in ("obj", "ply")),
        *(pytest.param("two parts", form, marks=pytest.mark.nightly) for form in ("obj", "glb")),
    ],
)
def test_saved_files_are_opened_again_with_their_map(model, form, opened, tmp_path):
    one = opened(model)
    one.does("unwrap", resolution=512)
    frames = [frame for frame in one.does("save", format=form) if frame.header["kind"] == "file"]
    for frame in frames:
        (tmp_path / frame.header["name"]).write_bytes(frame.arrays["content"].tobytes())
    again = Visitor(tmp_path / f"map.{form}")
    shown = again.last("map").header
    assert shown["injective"]
    assert shown["bijective"]
    assert shown["count"] == one.last("map").header["count"]
    assert shown["command"] == "", "the map of the file, unchanged"
