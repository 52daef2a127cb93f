"""The widget without a browser: messages in; frames, the map and its result out."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Problem, boundary_loops, certify, injective_map, solve
from quasiharmonic.atlas import SeamedMesh, as_seamed_mesh
from quasiharmonic.io import MeshData, checkerboard, own_texture, read_mesh, write_map
from quasiharmonic.surfaces import disk
from quasiharmonic.ui import notebook
from quasiharmonic.ui.studio import session
from quasiharmonic.ui.studio.page import bundle
from quasiharmonic.ui.studio.protocol import decode, encode

V, F = disk(5)
(LOOP,) = boundary_loops(F, len(V))
PROBLEM = Problem(V, F, LOOP, V[LOOP] * (1 + 0.3 * V[LOOP, :1]))


class Cell:
    """Display of the widget: stores what it sends, and passes a view's messages on like the kernel."""

    def __init__(self, monkeypatch):
        pytest.importorskip("anywidget")
        self.frames, self._listeners = [], []
        monkeypatch.setattr(
            notebook.MapWidget, "send", lambda _, content, buffers: self.frames.append((content, *buffers))
        )
        monkeypatch.setattr(notebook.MapWidget, "on_msg", lambda _, listener: self._listeners.append(listener))

    def show(self, *surface):
        self.widget = notebook.MapWidget(*surface)
        return self.widget

    def hear(self, *buffers):
        """Return the frames that answer a view's message."""
        self.frames.clear()
        self._listeners[-1](self.widget, {}, list(buffers))
        return [(content, decode(data)) for content, data in self.frames]

    def does(self, what, **words):
        return self.hear(memoryview(encode({"do": what, **words})))


@pytest.fixture
def cell(monkeypatch):
    return Cell(monkeypatch)


def test_a_displayed_problem_is_solved(cell):
    widget = cell.show(PROBLEM)
    assert widget.result.injective
    np.testing.assert_array_equal(widget.vertices, np.arange(len(V)))
    np.testing.assert_array_equal(widget.result.uv[LOOP], PROBLEM.target)
    np.testing.assert_array_equal(widget.result.V[:, :2], V)
    np.testing.assert_array_equal(widget.problem.target, widget.result.uv[widget.problem.fixed])
    assert "<img" in widget.result._repr_html_()


def test_a_later_view_receives_everything(cell):
    cell.show(PROBLEM)
    for _ in range(2):
        answered = cell.does("show")
        assert [content for content, _ in answered] == [
            {"kind": kind, "first": True} for kind in ("surface", "seams", "map", "obstructions", "image")
        ]
        (_, surface), _, (_, shown), *_ = answered
        np.testing.assert_array_equal(surface.arrays["triangles"], F)
        places = shown.arrays["places"] + np.array(shown.header["origin"])
        np.testing.assert_allclose(places, cell.widget.result.uv, atol=1e-6)


def test_the_map_follows_the_pointer(cell):
    widget = cell.show(PROBLEM)
    before, vertex = widget.result, int(LOOP[4])
    start = before.uv[vertex]
    cell.does("grab", vertex=vertex)
    for seq in range(1, 6):
        to = start * (1 + 0.04 * seq)
        (_, frame), *_ = cell.does("drag", vertex=vertex, to=to.tolist(), seq=seq)
        assert frame.header["seq"] == seq
        uv = frame.arrays["places"].astype(float)
        assert frame.header["injective"]
        assert certify(F, uv).injective
        np.testing.assert_allclose(uv[vertex] + frame.header["origin"], to, atol=1e-6)
    # During a drag, the result is the last map before it.
    np.testing.assert_array_equal(widget.result.uv, before.uv)
    cell.does("drop")
    assert widget.result.certificate.bijective
    np.testing.assert_allclose(widget.result.uv[vertex], to, atol=1e-12)
    # The result equals that of a separate solve.
    np.testing.assert_array_equal(widget.problem.target, widget.result.uv[widget.problem.fixed])
    assert solve(widget.problem).injective
    widget.undo()
    np.testing.assert_array_equal(widget.result.uv, before.uv)
    widget.redo()
    np.testing.assert_allclose(widget.result.uv[vertex], to, atol=1e-12)


def test_requests_of_the_kernel(cell):
    widget = cell.show(V, F)
    first = widget.result
    np.testing.assert_allclose(np.ptp(first.uv, axis=0), 1, atol=1e-12)
    widget.outline("rect:2x1")
    np.testing.assert_allclose(np.ptp(widget.result.uv, axis=0), (2, 1), atol=1e-12)
    widget.polish("mips")
    assert widget.result.injective
    with pytest.raises(ValueError, match="unknown outline 'nonsense'"):
        widget.outline("nonsense")
    with pytest.raises(ValueError, match="unknown energy 'heat'"):
        widget.polish("heat")
    assert widget.result.injective, "as it was"


def test_a_model_of_several_parts(cell):
    widget = cell.show(np.concatenate([V, V + 9]), np.concatenate([F, F + len(V)]))
    assert len(widget.mesh.islands) == 2
    assert widget.selected == [0, 1]
    widget.select([1])
    assert widget.selected == [1]
    before = widget.mesh.islands[0].uv
    widget.outline("rect:1x1")
    np.testing.assert_array_equal(widget.mesh.islands[0].uv, before)
    np.testing.assert_array_equal(widget.mesh.islands[1].uv, widget.result.uv)
    widget.flatten()
    widget.unwrap(resolution=np.int64(256))
    assert widget.mesh.uv.min() >= 0
    with pytest.raises(ValueError, match="max_stretch"):
        widget.unwrap(max_stretch=-1)
    with pytest.raises(ValueError, match=r"there is no island 7, only 0 \.\.\. 1"):
        widget.select([7])
    widget.select(0)
    assert widget.selected == [0]
    with pytest.raises(ValueError, match="islands must contain integer indices"):
        widget.select([0.9])


def test_image_selection_and_file_of_the_view(cell, tmp_path):
    """What a view does is seen in Python, and the other way round."""
    widget = cell.show(np.concatenate([V, V + 9]), np.concatenate([F, F + len(V)]))
    seen = []
    widget.observe(lambda change: seen.append((change["new"], widget.selected, widget.image)), "revision")
    assert widget.image is None
    cell.does("select", islands=[1])
    assert [selected for _, selected, _ in seen] == [[1]]
    board = checkerboard()
    (tmp_path / "board.png").write_bytes(board.data)
    widget.show_image(tmp_path / "board.png")
    assert seen[-1][2].data == board.data
    assert seen[-1][0] == seen[0][0] + 1
    (frame,) = (frame for content, frame in cell.does("show") if content["kind"] == "image")
    assert bytes(frame.arrays["content"]) == board.data
    widget.pack(resolution=256)
    for name in ("two.glb", "two.obj", "two.ply"):
        widget.save(tmp_path / name)
        saved = read_mesh(tmp_path / name)
        assert np.ptp(saved.vt, axis=0) == pytest.approx(np.ptp(widget.mesh.uv, axis=0), abs=1e-6)
    assert own_texture(read_mesh(tmp_path / "two.glb")).data == board.data
    with pytest.raises(ValueError, match="not a PNG or JPEG"):
        widget.show_image(tmp_path / "two.obj")


def test_an_interrupt_is_raised_and_the_widget_stays_usable(cell, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    widget = cell.show(V, F)
    before = widget.mesh
    with monkeypatch.context() as patch:
        patch.setattr(session, "unwrap_model", interrupt)
        patch.setattr(session, "make_first_state", interrupt)
        with pytest.raises(KeyboardInterrupt):
            widget.unwrap()
        with pytest.raises(KeyboardInterrupt):
            notebook.MapWidget(V, F)
        # An interrupted action of the view leaves the map, without an error in the kernel.
        cell.does("unwrap")
        assert widget.mesh is before
    widget.unwrap(resolution=256)
    assert widget.mesh is not before


def test_invalid_messages(cell):
    cell.show(PROBLEM)
    for buffers in ((), (b"nothing",), (b"\xff" * 40,)):
        ((content, frame),) = cell.hear(*buffers)
        assert content == {"kind": "note"}
        assert "a message" in frame.header["text"]
    ((_, frame),) = cell.does("explode")
    assert "unknown request" in frame.header["text"]


def test_every_kind_of_surface(cell, tmp_path):
    result = injective_map(V, F, LOOP, PROBLEM.target)
    write_map(tmp_path / "map.obj", MeshData(V, F), result.uv)
    for surface in ((result,), (tmp_path / "map.obj",), (str(tmp_path / "map.obj"),)):
        np.testing.assert_array_equal(cell.show(*surface).result.uv[LOOP], PROBLEM.target)
    assert cell.show({"vertices": V, "faces": F}).result.injective
    assert cell.show(V.tolist(), F.tolist()).result.injective
    pins = Problem(V, F, [*LOOP, 0], [*PROBLEM.target, [0.1, 0.1]])
    assert cell.show(pins).result.uv[0].tolist() == [0.1, 0.1]


def test_a_mesh_object_keeps_its_map(cell, tmp_path):
    right = V[F].mean(axis=1)[:, :1] > 0
    two = MeshData(V, F, vt=np.concatenate([V, V + 3.0]), FT=F + len(V) * right)
    for mesh in (two, as_seamed_mesh(two)):
        shown = cell.show(mesh).mesh
        assert len(shown.islands) == 2
        np.testing.assert_array_equal(shown.uv[shown.FT], two.vt[two.FT])
    with pytest.raises(ValueError, match=r"two\.off: OFF cannot store more than one pair"):
        cell.widget.save(tmp_path / "two.off")
    assert cell.show(SeamedMesh(V, F)).result.injective
    # The second component has no texture coordinates.
    G = np.concatenate([F, F + len(V)])
    partly = MeshData(np.concatenate([V, V + 9]), G, vt=V, FT=np.where(len(V) > G, G, -1))
    shown = cell.show(as_seamed_mesh(partly)).mesh
    np.testing.assert_array_equal(shown.uv[shown.FT[: len(F)]], V[F])


def test_a_mesh_of_trimesh_keeps_its_map(cell):
    trimesh = pytest.importorskip("trimesh")
    places, visual = np.pad(V, [(0, 0), (0, 1)]), trimesh.visual.TextureVisuals(uv=2 * V)
    shown = cell.show(trimesh.Trimesh(places, F, process=False, visual=visual)).result
    np.testing.assert_array_equal(shown.uv, 2 * V)
    assert cell.show(trimesh.Trimesh(places, F, process=False)).result.injective


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        (([1, 2, 3],), "a list is not a surface: pass V and F"),
        ((3,), "3 is not a surface"),
        (("nowhere.obj",), "nowhere.obj"),
        ((V, F[:0]), "no triangles"),
    ],
)
def test_invalid_surfaces(cell, surface, message):
    with pytest.raises((ValueError, OSError), match=message):
        cell.show(*surface)


def test_the_view_is_one_module():
    code = bundle("widget")
    assert "import " not in code.replace("// ", "")
    assert code.count("export") == 1
    assert "render" in code.rpartition("export")[2]


def test_without_anywidget(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "quasiharmonic.ui.notebook.widget", raising=False)
    monkeypatch.delitem(vars(notebook), "MapWidget", raising=False)
    with pytest.raises(ImportError, match=r"pip install '.*\[notebook\]'"):
        notebook.MapWidget  # noqa: B018
    with pytest.raises(AttributeError):
        notebook.View  # noqa: B018
