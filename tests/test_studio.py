"""The session of a studio page: dragging, what is certain about the shown map, and how to repeat it."""

from __future__ import annotations

import gc
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import Problem, certify, io, is_injective, quasi_harmonic_map
from quasiharmonic.surfaces import cat, grid
from quasiharmonic.ui.studio.drag import Follower, drag_weights
from quasiharmonic.ui.studio.history import Storage
from quasiharmonic.ui.studio.protocol import ProtocolError, decode, encode
from quasiharmonic.ui.studio.session import Session
from quasiharmonic.ui.studio.validation import make_outline, make_polygon, read_drawing
from shared.pages import Visitor, boundary

SVG = b'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10"><path d="M0 0 H10 V4 H4 V10 H0 Z"/></svg>'


def test_the_first_map_is_certified_and_sent_completely():
    one = Visitor()
    surface, shown = one.last("surface"), one.last("map")
    assert surface.header["triangles"] == 600
    assert surface.arrays["positions"].shape == (331, 3)
    assert shown.header["injective"]
    assert shown.header["bijective"]
    assert shown.header["reached"]
    places = shown.arrays["places"] + np.array(shown.header["origin"])
    assert np.allclose(places, one.session.state.result.uv, atol=1e-6)
    assert certify(one.session.state.problem.F, one.session.state.result.uv).bijective


def test_every_map_of_a_drag_is_positive_and_follows_the_pointer():
    one = Visitor()
    corner = one.session.state.corners[2]
    places = [(1 + 0.04 * k, 1 - 0.05 * k) for k in range(1, 15)]
    shown = one.drags(corner, *places)
    F = one.last("surface").arrays["triangles"].astype(np.int64)
    for frame, place in zip(shown, places, strict=True):
        assert frame.header["seq"] == places.index(place)
        assert frame.header["injective"]
        assert frame.header["reached"]
        assert frame.header["flips"] == 0
        uv = frame.arrays["places"].astype(np.float64) + frame.header["origin"]
        assert is_injective(F, uv)
        assert np.allclose(uv[corner], place, atol=1e-6)
    assert np.array_equal(one.place(corner), places[-1])
    assert one.last("map").header["state"] == "settled"


def test_an_updated_map_is_the_harmonic_map_of_the_last_tensors():
    """Compare with the library's solver, on the Beltrami coefficients of each triangle."""
    one = Visitor().session.state
    problem, uv = one.problem, one.result.uv
    target = problem.target * (1.2, 0.9) + 0.1 * problem.target[:, ::-1]
    followed = Follower(problem, uv, one.result.certificate).move_to(target)
    mesh = problem.domain.mesh("equilateral")
    d = mesh.derivatives(problem.frame.inward(uv))
    expected = quasi_harmonic_map(problem.with_target(target), d.q / d.p)
    assert followed.reached
    assert np.allclose(followed.uv, expected, atol=1e-9)


@pytest.mark.parametrize("across", [(-0.6, 0.5), (-1.5, -1.5)], ids=["crossing", "turned over"])
def test_an_unreachable_position_shows_a_certified_map_and_the_obstruction(across, monkeypatch):
    monkeypatch.setattr("quasiharmonic.ui.studio.drag.PATIENCE", 0.05)
    one = Visitor()
    corner = one.session.state.corners[2]
    # The corner is moved across the opposite side, so the outline crosses itself.
    one.does("grab", vertex=corner)
    frame = one.does("drag", seq=1, to=list(across))[-1]
    assert not frame.header["reached"]
    assert frame.header["injective"]
    uv = frame.arrays["places"].astype(np.float64)
    assert is_injective(one.last("surface").arrays["triangles"].astype(np.int64), uv)
    assert frame.arrays["asked"].shape == (60, 2)
    one.does("drop")
    settled = one.last("map").header
    assert not settled["bijective"]
    obstructions = one.last("obstructions").header["obstructions"]
    assert obstructions
    assert all(one["message"] and one["advice"] and (one["edges"] or one["vertices"]) for one in obstructions)
    assert settled["injective"] == (one.last("map").arrays["bad"].size == 0)
    # If there is no map to continue from, a search runs.
    if not settled["injective"]:
        assert settled["command"].startswith("qhm map ")


@pytest.mark.long
def test_many_movements_leave_no_extra_memory():
    one = Visitor(*cat(6))
    corner = one.session.state.corners[2]
    one.does("grab", vertex=corner)

    def moves(count):
        for k in range(count):
            one.does("drag", seq=k, to=[1 + 0.2 * np.cos(k / 9), 1 + 0.2 * np.sin(k / 9)])
            assert one.last("map").header["injective"]
            one.frames.clear()

    moves(50)
    tracemalloc.start()
    moves(50)
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    moves(250)
    gc.collect()
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 50_000


@pytest.mark.slow
def test_pins_stay_exactly_at_their_position_and_can_be_dragged():
    one = Visitor()
    one.does("pin", vertex=5)
    held = one.place(5).copy()
    assert one.last("map").header["pins"] == [5]
    corner = one.session.state.corners[0]
    one.drags(corner, (-0.1, -0.05))
    assert np.array_equal(one.place(5), held)
    goal = held + 0.05
    shown = one.drags(5, tuple(goal))
    assert all(frame.header["injective"] for frame in shown)
    assert np.array_equal(one.place(5), goal)
    one.does("unpin", vertex=5)
    assert one.last("map").header["pins"] == []


def test_undo_and_redo_are_exact():
    one = Visitor()
    first = one.session.state.result.uv
    one.drags(one.session.state.corners[1], (1.3, 0.1))
    second = one.session.state.result.uv
    one.does("undo")
    assert np.array_equal(one.session.state.result.uv, first)
    assert not one.last("map").header["undo"]
    assert one.last("map").header["redo"]
    one.does("redo")
    assert np.array_equal(one.session.state.result.uv, second)
    one.does("undo")
    one.does("pin", vertex=0)
    assert not one.last("map").header["redo"]


def test_a_corner_moves_straight_sides_and_a_side_bends_between_its_ends():
    V, F = grid(8, 8)
    problem = Problem(V, F, loop := boundary(V, F), V[loop])
    corners = [0, 8, 80, 72]
    share = dict(zip(loop.tolist(), drag_weights(80, loop, V[loop], problem.domain.loops, corners), strict=True))
    assert share[80] == 1
    assert share[8] == share[72] == share[0] == 0
    assert share[44] == pytest.approx(0.5)
    assert share[76] == pytest.approx(0.5)
    bent = dict(zip(loop.tolist(), drag_weights(4, loop, V[loop], problem.domain.loops, corners), strict=True))
    assert bent[4] == 1
    assert bent[3] == bent[5] == pytest.approx((1 - (0.125 / 0.32) ** 2) ** 2)
    assert bent[0] == bent[8] == 0
    with pytest.raises(ValueError, match="pin it first"):
        drag_weights(40, loop, V[loop], problem.domain.loops, corners)


def test_a_stored_session_continues_with_its_history(tmp_path):
    one = Visitor(*cat(6), storage=Storage(tmp_path / "session"))
    one.does("outline", to="disk")
    one.drags(int(one.session.state.islands[0].loops[0][0]), (0.1, 0.1))
    one.does("image", {"content": np.frombuffer(io.checkerboard().data, np.uint8)})
    one.does("undo")
    again = Visitor(storage=Storage(tmp_path / "session"), restore=True)
    shown, before = again.last("map"), one.last("map")
    assert np.array_equal(shown.arrays["places"], before.arrays["places"])
    for name in ("command", "undo", "redo", "unsaved", "outline"):
        assert shown.header[name] == before.header[name]
    assert again.last("image").header["type"] == "image/png"
    again.does("redo")
    one.does("redo")
    assert np.array_equal(again.last("map").arrays["places"], one.last("map").arrays["places"])
    again.does("undo")
    again.does("undo")
    assert again.last("map").header["outline"] == "rect:1x1"
    assert not again.last("map").header["undo"]
    assert not again.last("map").header["unsaved"]


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".ply", ".off"])
def test_a_stored_session_of_a_file_keeps_what_the_file_carries(tmp_path, suffix):
    V, F = cat(6)
    path = tmp_path / f"cat{suffix}"
    io.write_mapped(path, io.MeshData(V, F, vt=V[:, :2], FT=F))
    one = Visitor(*grid(4, 4), storage=Storage(tmp_path / "session"))
    one.does("load", {"content": np.frombuffer(path.read_bytes(), np.uint8)}, name=path.name)
    again = Visitor(storage=Storage(tmp_path / "session"), restore=True)
    assert again.session.state.sheet.name == path.name
    assert np.array_equal(again.last("map").arrays["places"], one.last("map").arrays["places"])
    saved = [there.session.state.sheet.mesh.carried for there in (one, again)]
    assert (saved[0] is None) == (saved[1] is None)


def test_a_page_continues_without_a_store(tmp_path, monkeypatch):
    one = Visitor(*cat(6), storage=Storage(tmp_path))

    def refuse(path, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", refuse)
    one.does("outline", to="disk")
    assert one.last("map").header["outline"] == "disk"
    assert "No space left on device" in one.last("note").header["text"]


def test_a_damaged_store_is_ignored(tmp_path):
    one = Visitor(*cat(6), storage=Storage(tmp_path))
    assert one.last("map").header["injective"]
    (tmp_path / "index").write_bytes(b"damaged")
    assert not Session(lambda header, arrays: None, storage=Storage(tmp_path)).restore()


def test_only_unsaved_changes_are_reported():
    one = Visitor(*cat(6))
    assert not one.last("map").header["unsaved"]
    one.does("outline", to="disk")
    assert one.last("map").header["unsaved"]
    one.does("save")
    one.does("stop")
    assert not one.last("map").header["unsaved"]


@pytest.mark.parametrize(
    "word",
    [
        "rect:drawing.svg",
        "/etc/passwd",
        "outline.csv",
        "letter:",
        "word:a b",
        "disk:1",
        3,
        None,
        "ellipse:1x2x3",
        "polygon:99999",
        "rect:1e9x1",
        "letter:RR",
    ],
)
def test_an_outline_is_a_name_and_never_a_file(word):
    with pytest.raises(ValueError, match=r"unknown outline .*: use disk"):
        make_outline(word)


def test_drawings_are_read_from_their_contents():
    assert len(read_drawing("../../x y.svg", SVG).contours[0]) == 6
    assert read_drawing("../../x y.svg", SVG).to == "x_y.svg"
    with pytest.raises(ValueError, match=r"^ä.svg: ") as raised:
        read_drawing("ä.svg", b"<svg")
    assert tempfile.gettempdir() not in str(raised.value)
    with pytest.raises(ValueError, match="3 to"):
        make_polygon(np.zeros((2, 2)))


@pytest.mark.parametrize(
    "words",
    [
        {"do": "grab", "vertex": -1},
        {"do": "grab", "vertex": 10**9},
        {"do": "grab", "vertex": "3"},
        {"do": "grab", "vertex": True},
        {"do": "drag", "seq": 1, "to": [0]},
        {"do": "drag", "seq": 1, "to": ["a", 0]},
        {"do": "drag", "seq": 1, "to": [1e300, 0]},
        {"do": "pin"},
        {"do": "polish", "energy": "none"},
        {"do": "__init__"},
        {"do": ["grab"]},
        {},
    ],
)
def test_invalid_messages_are_reported_and_change_nothing(words, visitor):
    before = visitor.session.state
    what = words.get("do")
    (note,) = visitor.does(what, **{k: v for k, v in words.items() if k != "do"})
    assert note.header["kind"] == "note"
    assert note.header["level"] == "error"
    assert visitor.session.state is before


def test_frames_are_decoded_unchanged():
    arrays = {"a": np.arange(5, dtype=np.uint8), "b": np.ones((2, 3), np.float32), "c": np.array([[1.5]])}
    frame = decode(encode({"kind": "x", "text": "ä"}, arrays))
    assert frame.header == {"kind": "x", "text": "ä"}
    for name, array in arrays.items():
        assert frame.arrays[name].dtype == array.dtype
        assert np.array_equal(frame.arrays[name], array)


WHOLE = encode({"do": "x"}, {"a": np.arange(9.0)})


@pytest.mark.parametrize(
    "data",
    [
        *(WHOLE[:cut] for cut in (0, 3, 7, 20, 60, len(WHOLE) - 1)),
        b"\xff\xff\xff\x7f" + WHOLE[4:],
        WHOLE.replace(b"[9]", b"[99]", 1).replace(b"}} ", b"}}", 1),
        WHOLE.replace(b"[9]", b"[-9]", 1),
        WHOLE.replace(b"f8", b"O8", 1),
        WHOLE.replace(b", 0]", b",-8]", 1),
        WHOLE.replace(b'"do"', b'{"do', 1),
        (4).to_bytes(4, "little") + b"null",
        (8).to_bytes(4, "little") + b"[1, 2, 3",
        (200_000).to_bytes(4, "little") + b"[" * 200_000,
    ],
)
def test_damaged_frames_are_rejected(data):
    with pytest.raises(ProtocolError):
        decode(data)


@pytest.mark.parametrize("error", [IndexError("index 9"), MemoryError("too large"), KeyError("a"), ValueError("bad")])
def test_an_exception_of_any_type_is_reported_and_the_state_stays(monkeypatch, error):
    one = Visitor()
    before = one.session.state

    def fail(*_, **__):
        raise error

    monkeypatch.setattr("quasiharmonic.ui.studio.session.turn_over", fail)
    one.does("turn")
    note = one.last("note").header
    assert note["level"] == "error"
    assert str(error) in note["text"]
    assert (type(error).__name__ in note["text"]) == (type(error) is not ValueError)
    assert one.session.state is before
    one.does("select", islands=[0])
    assert one.session.state.selected == (0,)
