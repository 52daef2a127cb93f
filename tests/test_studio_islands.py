"""Maps of files on a studio page, and the islands that a user repairs, moves, stitches and welds there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic import atlas, io, unwrap
from quasiharmonic.surfaces import cat, disk, grid, starfish
from shared.pages import Visitor


def two_squares(shift=(1.5, 0.0), mirrored=False):
    """Return a sheet of 4 by 2 squares as a map of two islands, the right one moved by a vector, perhaps mirrored."""
    V, F = grid(4, 2)
    right = V[F].mean(axis=1)[:, 0] > V[:, 0].mean()
    FT = F + len(V) * right[:, None]
    uv = np.concatenate([V, V * ([-1, 1] if mirrored else [1, 1]) + shift])
    return io.MeshData(np.pad(V, [(0, 0), (0, 1)]), F, vt=uv, FT=FT)


def opened(folder, mesh):
    path = folder / "model.obj"
    io.write_mapped(path, mesh)
    return Visitor(path)


def places(one):
    """Return the positions (f, 3, 2) of the corners."""
    mesh = one.session.state.mesh
    return mesh.uv[mesh.FT]


def test_a_map_with_inverted_triangles_is_shown_as_it_is_and_repaired(tmp_path, monkeypatch):
    V, F = cat(8)
    uv = V[:, :2].copy()
    inner = int(np.argmin(np.linalg.norm(uv - uv.mean(axis=0), axis=1)))
    uv[inner] = uv[:, 0].max(), uv[inner, 1]
    one = opened(tmp_path, io.MeshData(V, F, vt=uv, FT=F))
    expected = atlas.certify(atlas.SeamedMesh(V, F, uv=uv)).inverted
    shown = one.last("map").header
    assert (shown["injective"], shown["flips"], shown["command"]) == (False, len(expected), "")
    assert np.array_equal(places(one), uv[F])
    saved = one.files()
    assert saved["map.obj"] == (tmp_path / "model.obj").read_bytes()
    one.does("repair")
    shown = one.last("map").header
    assert shown["injective"]
    assert shown["command"] == "qhm repair model.obj -o repaired.obj"
    moved = (places(one) != uv[F]).any(axis=(1, 2))
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(shown["python"], names)
    assert np.array_equal(names["mesh"].uv[names["mesh"].FT], places(one))
    assert 0 < np.count_nonzero(moved) < len(F) / 2
    one.does("undo")
    assert not one.last("map").header["injective"]


def test_opening_and_saving_keeps_the_coordinates_of_a_model_with_defects(tmp_path):
    """The page maps a cleaned surface; the file has a repeated, a reversed and a degenerate triangle."""
    V, F = starfish(3, 6)
    F = np.concatenate([F, F[:1], [[3, 3, 5]]])
    F[7] = F[7, ::-1]
    result = unwrap(V, F)
    FT = result.indices.copy()
    uv = np.concatenate([result.uvs, [[0.25, 0.75], [0.5, 0.125]]])
    FT[-2:] = len(result.uvs)
    one = opened(tmp_path, io.MeshData(V, F, vt=uv, FT=FT))
    assert not one.session.state.sheet.is_file
    (tmp_path / "map.obj").write_bytes(one.files()["map.obj"])
    before, after = io.read_mesh(tmp_path / "model.obj"), io.read_mesh(tmp_path / "map.obj")
    assert before.vt.tobytes() == after.vt.tobytes()
    assert np.array_equal(before.FT, after.FT)
    one.does("place", to=[0.5, 0.0])
    (tmp_path / "map.obj").write_bytes(one.files()["map.obj"])
    assert not np.array_equal(io.read_mesh(tmp_path / "map.obj").corner_uv, before.corner_uv)


def test_mirrored_islands_are_measured_as_their_reflection(tmp_path):
    plain = opened(tmp_path, two_squares())
    mirrored = opened(tmp_path, two_squares(shift=(4.0, 0.0), mirrored=True))
    for name in ("worst", "energy", "scale", "injective", "bijective", "flips"):
        assert mirrored.last("map").header[name] == plain.last("map").header[name]
    assert mirrored.last("map").header["worst"] == pytest.approx(1)


def test_the_only_island_is_reflected_again_after_it_was_mirrored(tmp_path, monkeypatch):
    (V, F), inner = disk(4), 0
    one = opened(tmp_path, io.MeshData(V, F, vt=V, FT=F))
    one.does("pin", vertex=inner)
    one.does("place", to=[0, 0], mirror=True)
    shown = one.last("map").header
    assert (shown["injective"], shown["mirrored"]) == (False, True)
    refused = {"pack": {}, "polish": {"energy": "mips"}, "pin": {"vertex": inner}, "grab": {"vertex": inner}}
    for what, words in refused.items():
        assert "the map is mirrored: press Mirror or Repair" in one.does(what, **words)[-1].header["text"]
    mirrored = places(one)
    one.does("repair")
    shown = one.last("map").header
    assert (shown["bijective"], shown["mirrored"]) == (True, False)
    assert shown["pins"] == [inner]
    assert places(one) == pytest.approx(V[F])
    monkeypatch.chdir(tmp_path)
    for name, content in one.files().items():
        (tmp_path / name).write_bytes(content)
    names = {}
    exec(shown["python"], names)
    assert np.array_equal(names["mesh"].uv[names["mesh"].FT], places(one))
    one.does("undo")
    assert np.array_equal(places(one), mirrored)
    one.does("place", to=[0, 0], mirror=True)
    assert one.last("map").header["bijective"]


def test_a_reversed_boundary_is_mirrored_before_it_is_repaired(tmp_path):
    V, F = disk(4)
    uv = V * [-1, 1]
    uv[0] = 0.9, 0.0
    one = opened(tmp_path, io.MeshData(V, F, vt=uv, FT=F))
    assert not one.last("map").header["mirrored"]
    one.does("repair")
    (found,) = one.last("obstructions").header["obstructions"]
    assert found["advice"] == "Mirror the island, then press Repair."
    one.does("place", to=[0, 0], mirror=True)
    one.does("repair")
    assert one.last("map").header["bijective"]


def test_stitching_mirrored_islands_asks_for_a_reflection(tmp_path):
    mesh = two_squares(shift=(5.0, 0.0))
    one = opened(tmp_path, replace(mesh, vt=mesh.vt * [-1, 1]))
    vertex = int(np.flatnonzero(mesh.V[:, 0] == mesh.V[:, 0].mean())[0])
    assert "select all islands and press Mirror first" in one.does("stitch", vertex=vertex)[-1].header["text"]
    one.does("place", to=[0, 0], mirror=True)
    one.does("stitch", vertex=vertex)
    assert one.last("map").header["bijective"]
    assert one.last("map").header["count"] == 1


def test_islands_are_scaled_mirrored_and_snapped(tmp_path):
    one = opened(tmp_path, two_squares())
    before = places(one)
    one.does("select", islands=[1])
    right = one.session.state.islands[1].island.triangles
    one.does("place", to=[0, 0], scale=0.5)
    after = places(one)
    assert np.ptp(after[right], axis=(0, 1)) == pytest.approx(np.ptp(before[right], axis=(0, 1)) / 2)
    assert after[right].reshape(-1, 2).min(axis=0) + after[right].reshape(-1, 2).max(axis=0) == pytest.approx(
        before[right].reshape(-1, 2).min(axis=0) + before[right].reshape(-1, 2).max(axis=0)
    )
    one.does("place", to=[0, 0], mirror=True)
    assert one.session.state.islands[1].mirrored
    assert one.last("map").header["injective"]
    one.does("place", to=[0.013, 0.0171], resolution=64)
    low = places(one)[right].reshape(-1, 2).min(axis=0) * 64
    assert np.array_equal(low, np.rint(low))
    others = np.setdiff1d(np.arange(len(before)), right)
    assert np.array_equal(places(one)[others], before[others])
    text = one.does("place", to=[0, 0], scale=0)[-1].header["text"]
    assert "scale must be a number" in text


@pytest.mark.parametrize("mirrored", [False, True])
def test_stitch_brings_the_smaller_island_to_the_larger_one(mirrored, tmp_path):
    mesh = two_squares(mirrored=mirrored)
    one = opened(tmp_path, mesh)
    one.does("select", islands=[1])
    one.does("place", to=[0.3, 0.2], turn=30, scale=0.7)
    vertex = int(one.session.state.mesh.seams[0, 0])
    page = int(np.flatnonzero(one.session.state.numbering.origin == vertex)[0])
    one.does("stitch", vertex=page)
    shown = one.last("map").header
    assert (shown["count"], shown["injective"], shown["bijective"]) == (1, True, True)
    assert not len(one.session.state.mesh.seams)
    assert shown["worst"] == pytest.approx(1)
    one.does("undo")
    assert one.last("map").header["count"] == 2


def test_weld_joins_sides_that_are_less_than_a_texel_apart(tmp_path):
    one = opened(tmp_path, two_squares(shift=(1 / 4096, 0)))
    text = one.does("weld", resolution=8192)[-1].header["text"]
    assert "no two sides of a seam are closer than a texel" in text
    assert one.last("map").header["count"] == 2
    one.does("weld", resolution=1024)
    assert one.last("map").header["count"] == 1
    assert one.last("map").header["injective"]


def test_a_seam_that_cannot_be_stitched_is_refused_and_nothing_changes(tmp_path):
    """The seam of a tube: its two sides are at opposite ends of the map."""
    angle = 2 * np.pi * np.arange(8) / 8
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    V = np.concatenate([np.column_stack([ring, np.full(8, z)]) for z in (0.0, 1.0)])
    k = np.arange(8)
    ahead = (k + 1) % 8
    F = np.concatenate([np.stack([k, ahead, ahead + 8], axis=1), np.stack([k, ahead + 8, k + 8], axis=1)])
    FT = np.concatenate([np.stack([k, k + 1, k + 10], axis=1), np.stack([k, k + 10, k + 9], axis=1)])
    uv = np.stack([np.tile(np.arange(9), 2) / 9.0, np.repeat([0.0, 0.1], 9)], axis=1)
    one = opened(tmp_path, io.MeshData(V, F, vt=uv, FT=FT))
    before = one.session.state
    text = one.does("stitch", vertex=0)[-1].header["text"]
    assert "triangles would be inverted" in text
    assert one.session.state is before


def test_seams_are_required_forbidden_and_mirrored(tmp_path):
    V, F = starfish(4, 6)
    io.write_obj(tmp_path / "star.obj", io.MeshData(V, F))
    one = Visitor(tmp_path / "star.obj")
    n = len(one.session.state.sheet.surface.V)
    origin = one.session.state.numbering.origin
    page = {int(v): k for k, v in enumerate(origin)}
    start = int(np.argmax(V[:, 0]))
    assert n == len(V)
    end = int(np.setdiff1d(F[(start == F).any(axis=1)], start)[0])
    one.does("seam", start=page[start], vertex=page[end], forbid=True, symmetry="x")
    forbidden = one.session.state.forbidden
    mirror = {tuple(np.round([-x, y, z], 6)): k for k, (x, y, z) in enumerate(V)}
    image = {tuple(sorted(mirror[tuple(np.round(V[v], 6))] for v in pair)) for pair in forbidden.tolist()}
    assert image == {tuple(pair) for pair in forbidden.tolist()}
    assert one.last("seams").header["drawn"] is False
    one.does("unwrap", resolution=512)
    state = one.session.state
    assert not {tuple(e) for e in state.mesh.seams.tolist()} & image
    assert "--no-seams no_seams.txt" in one.last("map").header["command"]
    away = np.setdiff1d(forbidden, state.mesh.seams)[0]  # a seam at the vertex could be nearer
    one.does("erase", vertex=int(np.flatnonzero(state.numbering.origin == away)[0]), symmetry="x")
    assert len(one.session.state.forbidden) < len(forbidden)


def along(one, low, high):
    """Return the vertices of the page on the top row of a grid from one x to another."""
    V = one.session.state.numbering.V
    row = np.flatnonzero(V[:, 1] == V[:, 1].max())
    (start,), (end,) = (row[np.isclose(V[row, 0], x)] for x in (low, high))
    return {"start": int(start), "vertex": int(end)}


def test_erase_removes_only_marks_of_the_nearest_kind():
    one = Visitor(*grid(7, 2))
    x = np.unique(one.session.state.numbering.V[:, 0])

    def count():
        return len(one.session.state.wanted_seams), len(one.session.state.forbidden)

    def draw():
        one.does("seam", **along(one, x[0], x[4]))
        one.does("seam", **along(one, x[4], x[7]), forbid=True)
        return along(one, x[1], x[6])

    ends = draw()
    assert count() == (4, 3)
    one.does("erase", vertex=ends["vertex"])
    assert count() == (4, 0)
    draw()
    one.does("erase", vertex=ends["start"])
    assert count() == (0, 3)


def test_a_forbidden_edge_is_no_longer_a_seam():
    one = Visitor(*starfish(4, 6))
    n = len(one.session.state.mesh.seams)
    page = {int(v): k for k, v in enumerate(one.session.state.numbering.origin)}
    (a, b), *_, (c, d) = one.session.state.mesh.seams.tolist()
    one.does("seam", start=page[a], vertex=page[b], forbid=True)
    assert one.session.state.wanted_seams is None
    one.does("seam", start=page[c], vertex=page[d])
    assert len(one.session.state.wanted_seams) == n - 1
    one.does("seam", start=page[c], vertex=page[d], forbid=True)
    assert len(one.session.state.wanted_seams) == n - 2
    one.does("unwrap", resolution=256)
    assert one.session.state.wanted_seams is None, "no error"
    assert not {(a, b), (c, d)} & {tuple(edge) for edge in one.session.state.mesh.seams.tolist()}


def test_the_page_says_why_a_chosen_symmetry_was_not_applied(tmp_path):
    V, F = starfish(3, 8)
    io.write_obj(tmp_path / "star.obj", io.MeshData(V + 0.01 * np.random.default_rng(0).random(V.shape), F))
    one = Visitor(tmp_path / "star.obj")
    answers = one.does("unwrap", resolution=256, options={"symmetry": "y"})
    assert "in y: not mirrored, not every vertex has a mirror image" in answers[-1].header["text"]
    for symmetry in ("auto", "none"):
        answers = one.does("unwrap", resolution=256, options={"symmetry": symmetry})
        assert "note" not in [frame.header["kind"] for frame in answers]


def test_options_reach_unwrap_and_wrong_ones_are_named(tmp_path):
    V, F = starfish(3, 8)
    io.write_obj(tmp_path / "star.obj", io.MeshData(V, F))
    one = Visitor(tmp_path / "star.obj")
    one.does("unwrap", resolution=512, options={"max_stretch": 1.2, "hard_edges": 40, "symmetry": "none"})
    command = one.last("map").header["command"]
    assert "--max-stretch 1.2" in command
    assert "--hard-edges 40" in command
    assert "--symmetry none" in command
    expected = unwrap(V, F, resolution=512, padding=4, max_stretch=1.2, hard_edges=40, symmetry=None)
    assert np.array_equal(places(one), expected.uvs[expected.indices])
    for wrong in ({"seed": 1}, {"max_stretch": "wide"}, {"symmetry": "w"}, {"labels": "walls"}, 5):
        before = one.session.state
        assert one.does("unwrap", options=wrong)[-1].header["kind"] == "note"
        assert one.session.state is before


def test_selected_islands_are_unwrapped_and_the_others_stay(tmp_path):
    V, F = starfish(3, 8)
    io.write_obj(tmp_path / "star.obj", io.MeshData(V, F))
    one = Visitor(tmp_path / "star.obj")
    one.does("unwrap", resolution=512)
    before, count = places(one), one.last("map").header["count"]
    assert count > 2
    triangles = one.session.state.islands[0].island.triangles
    one.does("select", islands=[0])
    one.does("unwrap", resolution=512, selected=True, options={"max_stretch": 1.05, "texels_per_unit": 60})
    others = np.setdiff1d(np.arange(len(F)), triangles)
    assert np.array_equal(places(one)[others], before[others])
    assert not np.array_equal(places(one)[triangles], before[triangles])
    assert one.last("map").header["bijective"]


@pytest.mark.parametrize("what", ["unwrap", "flatten"])
def test_stop_keeps_the_best_certified_result(what):
    made = list[Visitor]()

    def stops():
        shown = [frame.header for one in made for frame in one.frames[opened:] if frame.header["kind"] == "progress"]
        return any(header.get("phase") == "improve" or "energy" in header for header in shown)

    one = Visitor(*starfish(3, 12), waiting=stops, stops=stops)
    before, opened = one.session.state, len(one.frames)
    made.append(one)
    one.does(what)
    assert stops()
    assert one.session.state is not before
    assert one.last("map").header["injective"]
    assert one.last("map").header["command"] == "qhm check start.obj"


def test_stop_at_the_first_of_two_selected_islands(tmp_path):
    V, F = grid(36, 12)
    column = (3 * V[F].mean(axis=1)[:, 0]).astype(int)
    FT = F + len(V) * column[:, None]
    uv = np.concatenate([np.add(V, [2 * k, 0]) for k in range(3)])
    made = list[Visitor]()

    def stops():
        return any("energy" in frame.header for one in made for frame in one.frames[opened:])

    io.write_mapped(tmp_path / "model.obj", io.MeshData(np.pad(V, [(0, 0), (0, 1)]), F, vt=uv, FT=FT))
    one = Visitor(tmp_path / "model.obj", waiting=stops, stops=stops)
    one.does("select", islands=[0, 2])
    before, opened = places(one), len(one.frames)
    made.append(one)
    one.does("outline", to="letter:C")
    assert stops()
    assert not [frame for frame in one.frames[opened:] if frame.header["kind"] == "note"]
    assert one.last("map").header["injective"]
    assert np.array_equal(places(one)[column > 0], before[column > 0])
