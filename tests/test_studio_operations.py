"""Operations of a studio page: which of them are refused after the seams have changed, and what a state keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic.surfaces import cat, starfish
from quasiharmonic.ui.studio import setup
from quasiharmonic.ui.studio.messages import describe_obstructions
from quasiharmonic.ui.studio.session import Session
from quasiharmonic.ui.studio.state import SessionState
from shared.pages import Visitor

SVG = np.frombuffer(b'<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0h9v9h-9z"/></svg>', np.uint8)
POINTS = np.array([0, 0, 2, 0, 1, 1.0])
# Operations that would lose the seams that the user changed: fields and arrays of a valid message.
REFUSED = {
    "outline": ({"to": "disk"}, {}),
    "drawing": ({"name": "square.svg"}, {"content": SVG}),
    "polygon": ({}, {"points": POINTS}),
    "corner": ({"vertex": 0}, {}),
    "corners": ({}, {}),
    "turn": ({}, {}),
    "stitch": ({"vertex": 0}, {}),
    "weld": ({}, {}),
    "repair": ({}, {}),
    "place": ({"to": [1, 0]}, {}),
    "pack": ({}, {}),
    "polish": ({"energy": "mips"}, {}),
    "grab": ({"vertex": 0}, {}),
}
KEPT = {"seam", "erase", "pin", "unpin", "flatten", "unwrap", "select", "image", "save", "stop", "undo", "redo"}
# Without `grab` there is no drag.
DRAGS = {"drag", "drop"}


@pytest.fixture(scope="module")
def with_changed_seams():
    one = Visitor(*cat(6))
    V = one.session.state.numbering.V
    one.does("seam", start=int(np.argmin(V[:, 0])), vertex=int(np.argmax(V[:, 0])))
    return one


def test_every_message_keeps_the_changed_seams_or_is_refused():
    commands = {name.removeprefix("_do_") for name in dir(Session) if name.startswith("_do_")}
    assert commands == {*REFUSED, *KEPT, *DRAGS, "load"}


@pytest.mark.parametrize("what", REFUSED)
def test_an_operation_that_would_lose_changed_seams_is_refused(with_changed_seams, what):
    one, (words, arrays) = with_changed_seams, REFUSED[what]
    before = one.session.state
    answers = one.does(what, arrays, **words)
    assert "the seams have changed: press Unwrap or Flatten" in answers[-1].header["text"]
    assert one.session.state is before
    # The page has already moved the islands, so it needs the map again.
    assert ("map" in [frame.header["kind"] for frame in answers]) == (what == "place")


def test_a_new_state_ends_a_drag():
    one = Visitor(*cat(6))
    corner = one.session.state.corners[0]
    one.does("grab", vertex=corner)
    one.does("drag", seq=1, to=[0.1, 0.1])
    V = one.session.state.numbering.V
    one.does("seam", start=int(np.argmin(V[:, 0])), vertex=int(np.argmax(V[:, 0])))
    before = one.session.state
    assert one.does("drop") == []
    assert one.session.state is before


@pytest.mark.slow
def test_stop_keeps_a_map_that_is_found_at_the_end_of_a_drag():
    """The drag starts without a map, so only the search at its end finds one."""
    made = list[Visitor]()

    def stops():
        return any("energy" in frame.header for one in made for frame in one.frames[dropped:])

    one = Visitor(waiting=stops, stops=stops)
    corner, first = one.session.state.corners[2], one.session.state
    one.drags(corner, (-1.5, -1.5))
    assert not one.session.state.injective
    dropped = len(one.frames)
    made.append(one)
    one.drags(corner, tuple(first.uv[corner]))
    assert stops()
    assert one.session.state.injective
    assert one.last("map").header["command"] == "qhm check start.obj"


def test_unpinning_a_vertex_that_is_not_pinned_changes_nothing(monkeypatch):
    monkeypatch.setattr(setup, "MAX_AUTOMATIC", 100)
    one = Visitor(*starfish(3, 8))
    assert not one.session.state.mapped
    assert one.does("unpin", vertex=0) == []


def test_a_model_without_a_map_keeps_its_forbidden_edges_when_it_is_turned(monkeypatch):
    monkeypatch.setattr(setup, "MAX_AUTOMATIC", 100)
    V, F = starfish(3, 8)
    one = Visitor(V, F)
    one.does("seam", start=int(F[0, 0]), vertex=int(F[0, 1]), forbid=True)
    forbidden = one.session.state.forbidden
    one.does("turn")
    assert one.session.state.sheet.turned
    assert np.array_equal(one.session.state.forbidden, forbidden)
    assert len(forbidden) == 1


@pytest.mark.parametrize("reworded", [False, True])
@pytest.mark.parametrize(
    ("place", "says"), [([-0.6, 0.5], "the boundary crosses itself"), ([-1.5, -1.5], "the map is turned over")]
)
def test_the_kind_of_an_obstruction_decides_what_a_drag_did(place, says, reworded):
    one = Visitor(*cat(6))
    one.drags(one.session.state.corners[2], place)
    (shown,) = one.last("obstructions").header["obstructions"]
    assert says in shown["message"]
    if reworded:
        state = one.session.state
        found = state.result.diagnosis
        found = replace(found, obstructions=tuple(replace(each, message="words") for each in found.obstructions))
        island = replace(state.active, result=replace(state.result, diagnosis=found))
        (again,) = describe_obstructions(state.with_island(0, island))
        assert again["message"] == shown["message"]


@pytest.mark.slow
def test_messages_and_operations_do_not_write_into_the_map(monkeypatch):
    """They get the same array at each access, which cannot be written."""
    compute, made = SessionState.uv.fget, {}

    def frozen(state):
        uv = made.setdefault(state, compute(state))
        uv.setflags(write=False)
        return uv

    monkeypatch.setattr(SessionState, "uv", property(frozen))
    one = Visitor(*starfish(3, 8))
    assert one.session.state.mapped
    vertex = int(one.session.state.islands[0].loops[0][0])
    (shown,) = one.drags(vertex, one.session.state.uv[vertex].tolist())
    assert shown.header["state"] == "following"
    # The islands become smaller than a texel.
    one.does("place", to=[0, 0], scale=0.001)
    for what in ("weld", "stitch"):
        one.does(what, vertex=0, resolution=16)
        assert one.last("note").header["text"].startswith("joined there,")


def test_older_snapshots_are_read():
    state = Visitor(*cat(6)).session.state
    contents = state.__getstate__()
    contents["drawn"] = seams = np.array([[0, 1]])
    del contents["wanted_seams"]
    read = SessionState.__new__(SessionState)
    read.__setstate__(contents)
    assert read.wanted_seams is seams
    assert read.mesh is state.mesh
