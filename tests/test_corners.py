"""Corners of a boundary: turning angles, choice by angle, specification by name, and the command's output."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from quasiharmonic import boundary_loops, io, surfaces
from quasiharmonic.targets import (
    BoundaryLoop,
    boundary_corners,
    boundary_to,
    boundary_turning,
    nearest_on_boundary,
    outline,
    rectangle,
    ring,
)
from quasiharmonic.targets.boundary.corner_pins import read_corners
from quasiharmonic.ui.cli import main
from shared.commands import run
from shared.meshes import lift, random_annulus


def angle_sums(V, F):
    """Return the angle sum of each vertex by the law of cosines, triangle by triangle."""
    total = np.zeros(len(V))
    for face in F:
        for k in range(3):
            here, one, other = V[np.roll(face, -k)]
            a, b, c = (np.linalg.norm(x) for x in (one - here, other - here, one - other))
            total[face[k]] += np.arccos((a * a + b * b - c * c) / (2 * a * b))
    return total


def straightness(lengths, turning, corners):
    """Return the sum over runs of the integral that the choice of corners minimises, edge by edge."""
    n, total = len(lengths), 0.0
    for a, b in itertools.pairwise([*corners, corners[0] + n]):
        direction, run = 0.0, []
        for e in range(a, b):
            direction += turning[e % n] if e > a else 0.0
            run.append((lengths[e % n], direction))
        mean = sum(x * y for x, y in run) / sum(x for x, _ in run)
        total += sum(x * (y - mean) ** 2 for x, y in run)
    return total


def rolled(V, radius=0.25):
    """Return a sheet bent around a cylinder, which changes the lengths and angles of chords only."""
    return np.stack([radius * np.cos(V[:, 0] / radius), V[:, 1], radius * np.sin(V[:, 0] / radius)], axis=1)


def cut_out(V, F, keep):
    used, F = np.unique(F[keep], return_inverse=True)
    return V[used], F.reshape(-1, 3)


def l_shape():
    V, F = surfaces.grid(12, 12)
    middle = V[F].mean(axis=1)
    return cut_out(V, F, ~((middle > 1 / 3).all(axis=1)))


# --- turning


@pytest.mark.slow
def test_turning_is_pi_minus_the_angle_sum():
    V, F = random_annulus()
    for points in (V, lift(V), lift(V)[:, [2, 0, 1]]):
        angle = angle_sums(points, F)
        for loop in boundary_turning(points, F):
            np.testing.assert_allclose(loop.turning, np.pi - angle[loop.vertices], atol=1e-7)
            ahead = points[np.roll(loop.vertices, -1)]
            np.testing.assert_allclose(loop.lengths, np.linalg.norm(ahead - points[loop.vertices], axis=1))


@pytest.mark.slow
def test_gauss_and_bonnet():
    V, F = surfaces.cat(12)
    (loop,) = boundary_turning(V, F)
    inner = np.setdiff1d(np.arange(len(V)), loop.vertices)
    curvature = (2 * np.pi - angle_sums(V, F)[inner]).sum()
    assert loop.turning.sum() == pytest.approx(2 * np.pi - curvature)
    assert loop.corners(5)[1].sum() == pytest.approx(loop.turning.sum())


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e150, 1e300])
def test_the_unit_of_length_does_not_matter(scale):
    V, F = surfaces.grid(6, 4)
    (loop,), (wanted,) = boundary_turning(V * scale, F), boundary_turning(V, F)
    np.testing.assert_allclose(loop.turning, wanted.turning, atol=1e-12)
    np.testing.assert_allclose(loop.lengths / scale, wanted.lengths)
    assert boundary_corners(V * scale, F, 4).tolist() == boundary_corners(V, F, 4).tolist()


def test_orientation_of_a_planar_mesh_does_not_matter():
    V, F = surfaces.grid(6, 4)
    assert sorted(boundary_corners(V, F[:, ::-1], 4)) == sorted(boundary_corners(V, F, 4))


# --- corners by angle


@pytest.mark.parametrize("shape", [(12, 8), (40, 2), (3, 90)])
@pytest.mark.parametrize("bent", [False, True])
def test_a_sheet_has_its_four_corners(shape, bent):
    V, F = surfaces.grid(*shape)
    V = V * shape
    nx = shape[0] + 1
    wanted = {0, nx - 1, len(V) - nx, len(V) - 1}
    assert set(boundary_corners(rolled(V, 9.0) if bent else V, F, 4).tolist()) == wanted


def test_in_order_with_the_surface_to_the_left():
    V, F = surfaces.grid(5, 5)
    (loop,) = boundary_loops(F, len(V))
    position = [loop.tolist().index(v) for v in boundary_corners(V, F, 4)]
    assert position == sorted(position)


def test_notches_turn_in_the_opposite_direction():
    V, F = l_shape()
    (loop,) = boundary_turning(V, F)
    positions, turning = loop.corners(6)
    assert {tuple(p) for p in (12 * V[loop.vertices[positions]]).round().astype(int).tolist()} == {
        (0, 0), (12, 0), (12, 4), (4, 4), (4, 12), (0, 12),
    }  # fmt: skip
    np.testing.assert_allclose(np.sort(np.degrees(turning)), [-90, 90, 90, 90, 90, 90], atol=1e-9)


def test_ragged_sides_are_not_corners():
    """A square whose boundary zigzags by 60° has four corners, although every vertex is sharper than these."""
    V, F = surfaces.grid(20, 20)
    (loop,) = boundary_loops(F, len(V))
    corner = {0, 20, 420, 440}
    for k, v in enumerate(loop.tolist()):
        if v not in corner and k % 2:
            V[v] += 0.07 * (0.5 - V[v]) * (np.abs(V[v] - 0.5) == 0.5)
    (found,) = boundary_turning(V, F)
    assert np.abs(np.degrees(found.turning)).mean() > 60
    chosen = boundary_corners(V, F, 4)
    off = np.abs(V[chosen][:, None] - [(0, 0), (1, 0), (1, 1), (0, 1)]).max(axis=2).min(axis=1)
    assert off.max() <= 0.051


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 16])
def test_a_circle_is_divided_evenly(count):
    V, F = surfaces.disk(16)
    (loop,) = boundary_turning(V, F)
    positions, turning = loop.corners(count)
    gaps = np.diff(positions, append=positions[0] + len(loop.vertices))
    assert gaps.max() - gaps.min() <= 2
    assert turning.sum() == pytest.approx(2 * np.pi)


def test_further_corners_divide_straight_sides():
    V, F = surfaces.grid(8, 6)
    V = V * [8, 2]
    found = {tuple(p) for p in V[boundary_corners(V, F, 6)].tolist()}
    assert found == {(0, 0), (8, 0), (8, 2), (0, 2), (4, 0), (4, 2)}


def with_bend(lengths, turning):
    """Add the term that every loop gets, so that straight sides are divided evenly."""
    return turning + 0.01 * (lengths + np.roll(lengths, 1)) / 2 / lengths.sum()


@pytest.mark.slow
@given(
    st.lists(st.tuples(st.floats(0.2, 1), st.floats(-2, 2)), min_size=6, max_size=13),
    st.integers(2, 4),
)
@settings(max_examples=60, deadline=None)
def test_no_single_corner_has_a_better_position_between_its_neighbours(loop, count):
    lengths, turning = np.array(loop).T
    n = len(loop)
    found = BoundaryLoop(np.arange(n), lengths, turning).corners(count)[0].tolist()
    turning = with_bend(lengths, turning)
    reached, none = straightness(lengths, turning, found), straightness(lengths, turning, [0])
    for j in range(count):
        others = found[:j] + found[j + 1 :]
        low, high = found[j - 1], found[(j + 1) % count]
        between = [k for k in range(n) if k not in others and 0 < (k - low) % n < ((high - low) % n or n)]
        # Choices that are equal up to rounding are equally good.
        assert reached <= min(straightness(lengths, turning, sorted([*others, k])) for k in between) + 1e-8 * none


@pytest.mark.long
def test_the_runs_are_almost_as_straight_as_possible():
    """Compare with all choices: nine of ten random loops get the best corners, and few get much worse ones."""
    rng = np.random.default_rng(0)
    excess = []
    for _ in range(120):
        n, count = int(rng.integers(6, 14)), int(rng.integers(2, 5))
        lengths, turning = rng.uniform(0.2, 1, n), rng.uniform(-2, 2, n)
        found = BoundaryLoop(np.arange(n), lengths, turning).corners(count)[0].tolist()
        turning = with_bend(lengths, turning)
        best = min(straightness(lengths, turning, c) for c in itertools.combinations(range(n), count))
        excess.append((straightness(lengths, turning, found) - best) / straightness(lengths, turning, [0]))
    assert np.mean(np.array(excess) < 1e-9) > 0.88
    assert np.quantile(excess, 0.99) < 0.06


def test_the_loop_around_the_largest_area():
    V, F = surfaces.annulus(8)
    outer = max(boundary_loops(F, len(V)), key=lambda loop: np.linalg.norm(V[loop], axis=1).min())
    assert np.isin(boundary_corners(V, F, 5), outer).all()


@pytest.mark.parametrize(
    ("count", "message"),
    [(0, "at least 1"), (2.5, "an integer of at least"), (25, "the loop has 24 vertices, too few for 25 corners")],
)
def test_impossible_numbers_of_corners(count, message):
    with pytest.raises(ValueError, match=message):
        boundary_corners(*surfaces.disk(4), count)


def test_surfaces_without_a_boundary():
    tetrahedron = np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    assert boundary_turning(*tetrahedron) == []
    with pytest.raises(ValueError, match="the surface is closed: it has no boundary with corners"):
        boundary_corners(*tetrahedron, 3)
    with pytest.raises(ValueError, match="the surface is closed: it has no boundary vertices"):
        nearest_on_boundary(*tetrahedron, [(0, 0, 0)])


# --- onto an outline


@pytest.mark.parametrize("degrees", [0, 40, 90, 180, 200, 270])
def test_convex_corners_go_to_convex_corners_for_every_orientation_of_the_surface(degrees):
    V, F = l_shape()
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    (letter,) = outline("letter:L")
    fixed, target = boundary_to(V @ [[c, s], [-s, c]], F, letter, corners="auto")
    where = dict(zip(map(tuple, target.tolist()), map(tuple, V[fixed].tolist()), strict=True))
    corners = [where[tuple(point)] for point in letter.tolist()]
    np.testing.assert_allclose(corners, [(0, 1), (0, 0), (1, 0), (1, 1 / 3), (1 / 3, 1 / 3), (1 / 3, 1)], atol=1e-12)


def test_a_sheet_stays_upright():
    V, F = surfaces.grid(9, 6)
    for points in (V, np.column_stack([V, 0.1 * V[:, 0] ** 2])):
        fixed, target = boundary_to(points, F, rectangle(2, 1), corners="auto")
        where = dict(zip(fixed.tolist(), target.tolist(), strict=True))
        assert [where[v] for v in (0, 9, 69, 60)] == [[0, 0], [2, 0], [2, 1], [0, 1]]


def test_long_sides_go_to_long_sides():
    """On its own shape, a sheet has the same distortion in every orientation; on a square it stays upright."""
    V, F = surfaces.grid(20, 10)
    V = V * [2, 1]
    for degrees in (0, 20, 45, 70, 90, 135):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        fixed, target = boundary_to(V @ [[c, s], [-s, c]], F, rectangle(2, 1), corners="auto")
        off = min(np.abs(target - place).max() for place in (V[fixed], (2, 1) - V[fixed]))
        assert off < 1e-9
    fixed, target = boundary_to(V @ [[0, 1], [-1, 0]], F, rectangle(1, 1), corners="auto")
    where = dict(zip(fixed.tolist(), target.tolist(), strict=True))
    assert [where[v] for v in (0, 20, 230, 210)] == [[1, 0], [1, 1], [0, 1], [0, 0]]


def test_outlines_without_corners_and_with_holes():
    V, F = surfaces.annulus(8)
    for contours in (ring(0.4), [rectangle(4, 4) - 2, rectangle(1, 1)]):
        fixed, _ = boundary_to(V, F, contours, corners="auto")
        assert sorted(fixed) == sorted(np.concatenate(boundary_loops(F, len(V))))
    assert np.array_equal(boundary_to(V, F, ring(0.4), corners="auto")[1], boundary_to(V, F, ring(0.4))[1])
    with pytest.raises(ValueError, match="corners are boundary vertices or \"auto\", not 'sharp'"):
        boundary_to(V, F, contours, corners="sharp")
    with pytest.raises(ValueError, match="the loop has 6 vertices, too few for 10 corners"):
        boundary_to(*surfaces.disk(1), outline("star:5")[0], corners="auto")


# --- corner specifications


def test_nearest_on_boundary():
    V, F = surfaces.grid(6, 4)
    V = lift(V)
    (loop,) = boundary_loops(F, len(V))
    places = np.random.default_rng(0).normal(size=(40, 3))
    wanted = [loop[np.argmin([np.linalg.norm(V[v] - p) for v in loop])] for p in places]
    for scale in (1, 1e-200, 1e200):
        assert nearest_on_boundary(V * scale, F, places * scale).tolist() == wanted
    flat = surfaces.grid(6, 4)
    assert (
        nearest_on_boundary(*flat, [(0.1, -3)]).tolist() == nearest_on_boundary(*flat, [(0.1, -3, 0)]).tolist() == [1]
    )


@pytest.mark.parametrize(
    ("text", "entries"),
    [
        ("auto", "auto"),
        ("4,5", ((4, None), (5, None))),
        ("near:0,1,2", (((0, 1, 2), None),)),
        ("near:0,1,2,near:-1.5,1e3,0,7", (((0, 1, 2), None), ((-1.5, 1000, 0), None), (7, None))),
        ("near:0,1,2:3,4:0.5:0", (((0, 1, 2), 3), (4, (0.5, 0)))),
        ("near:0,1,2:0.5:-1", (((0, 1, 2), (0.5, -1)),)),
        ("near: 0, 1, 2, 4", (((0, 1, 2), None), (4, None))),
    ],
)
def test_specifications_of_corners_are_read(text, entries):
    assert read_corners(text).entries == entries


def test_specifications_in_a_file(tmp_path):
    (tmp_path / "c.txt").write_text("\ufeff# corners\nnear:0, 1, 2 3\n\n4 0\nnear:0,1,5:1\n9:2 # the last\n")
    assert read_corners(str(tmp_path / "c.txt")).entries == (((0, 1, 2), 3), (4, 0), ((0, 1, 5), 1), (9, 2))
    (tmp_path / "c.txt").write_text("# none\n")
    with pytest.raises(ValueError, match="the file names no corners"):
        read_corners(str(tmp_path / "c.txt"))


@pytest.mark.parametrize(
    "text", ["near:0,1", "near:0,1,x", "near:0,1,nan", "near:", "near:1,2,3:x", "next:1,2,3", "auto,3"]
)
def test_specifications_that_cannot_be_read(text):
    with pytest.raises(
        ValueError, match=r"is not one of V, V:K and V:X:Y, where near:x,y,z may stand for the vertex V"
    ):
        read_corners(text)


@pytest.mark.parametrize("text", ["9" * 4000, "9" * 5000, "3:" + "9" * 4000])
def test_very_large_numbers_are_shortened_in_the_message(text):
    with pytest.raises(ValueError, match=r"is not one of V, V:K and V:X:Y") as refused:
        read_corners(text)
    assert len(str(refused.value)) < 200


def test_two_specifications_for_one_vertex():
    mesh = surfaces.grid(4, 4)
    for text, message in (
        ("near:-1,-1,0,near:-2,-1,0", "near:-1,-1,0 and near:-2,-1,0 are the same boundary vertex, 0"),
        ("0,near:-2,-1,0", "vertex 0 and near:-2,-1,0 are the same boundary vertex, 0"),
        ("3,0,0", "vertex 0 is named more than once"),
    ):
        with pytest.raises(ValueError, match=message):
            read_corners(text).on(*mesh)
    with pytest.raises(ValueError, match=r"the vertex near \(0.0, 1.0, 2.0\) has no corner or point"):
        read_corners("near:0,1,2,4:3")


# --- the commands


@pytest.fixture
def sheet(tmp_path):
    io.write_obj(tmp_path / "in.obj", io.MeshData(*surfaces.grid(9, 6)))
    return tmp_path / "in.obj"


@pytest.mark.parametrize(
    ("corners", "places"),
    [
        ("auto", {0: (0, 0), 9: (2, 0), 69: (2, 1), 60: (0, 1)}),
        ("near:0.01,-3,0,near:1.2,0,0,near:1,1,1,60", {0: (0, 0), 9: (2, 0), 69: (2, 1), 60: (0, 1)}),
        ("near:0,1,0:3,9:1", {60: (0, 1), 9: (2, 0)}),
        ("near:0,0,0:0.5:0,near:1,1,0:2:0.75", {0: (0.5, 0), 69: (2, 0.75)}),
    ],
)
@pytest.mark.parametrize("slide", [[], ["--slide"]])
def test_corners_of_the_surface_get_their_positions_on_the_outline(sheet, corners, places, slide):
    out = sheet.with_name("out.obj")
    assert run("map", sheet, "-o", out, "--to", "rect:2x1", "--corners", corners, *slide) == 0
    uv = io.map_of(io.read_mesh(out))
    assert [tuple(uv[v]) for v in places] == [pytest.approx(place, abs=1e-15) for place in places.values()]


def test_corners_by_angle_are_printed_as_a_specification(sheet, capsys):
    out = sheet.with_name("out.obj")
    assert run("map", sheet, "-o", out, "--to", "star:5", "--corners", "auto", "--refine") == 0
    (said,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("corners by angle")]
    chosen = said.split("--corners ")[1]
    assert len(chosen.split(",")) == 10
    uv = io.read_mesh(out).vt
    assert run("map", sheet, "-o", out, "--to", "star:5", "--corners", chosen, "--refine") == 0
    np.testing.assert_array_equal(io.read_mesh(out).vt, uv)


def test_map_with_invalid_corners(sheet, capsys):
    out = sheet.with_name("out.obj")
    assert run("map", sheet, "-o", out, "--to", "rect:2x1", "--corners", "near:1,2") == 2
    assert "--corners near:1,2: 'near:1,2' is not one of V, V:K" in capsys.readouterr().err
    assert run("map", sheet, "-o", out, "--to", "star:30", "--corners", "auto") == 2
    assert "in.obj --to star:30: the loop has 30 vertices, too few for 60 corners" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_the_command_lists_the_corners_of_a_boundary(sheet, capsys):
    picture, report = sheet.with_name("b.png"), sheet.with_name("b.json")
    assert run("check", sheet, "--boundary", "--plot", picture, "--json", report) == 0
    said = capsys.readouterr().out
    assert "1 boundary loop; vertices are counted from 0" in said
    assert "loop 0: 30 vertices, length 4, the surface to the left" in said
    assert "corner: vertex 9 at (1, 0, 0), turning by 90° at the vertex, by 90°" in said
    (loop,) = json.loads(report.read_text())["loops"]
    V, F = surfaces.grid(9, 6)
    assert loop["vertices"] == boundary_loops(F, len(V))[0].tolist()
    assert {corner["vertex"] for corner in loop["corners"]} == {0, 9, 60, 69}
    assert [corner["turning"] for corner in loop["corners"]] == pytest.approx([90] * 4)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_check_boundary_without_a_map_with_several_loops_and_without_loops(tmp_path, capsys):
    mesh = tmp_path / "in.obj"
    io.write_obj(mesh, io.MeshData(lift(surfaces.annulus(30)[0]), surfaces.annulus(30)[1]))
    assert run("check", mesh, "--boundary", "--plot", tmp_path / "b.png") == 0
    said = capsys.readouterr().out
    assert "2 boundary loops" in said
    assert "loop 1:" in said
    assert "in all; --json lists them" in said
    io.write_obj(mesh, io.MeshData(np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    assert main(["check", str(mesh), "--boundary", "--plot", str(tmp_path / "b.png")]) == 0
    assert "the surface is closed" in capsys.readouterr().out


def test_invalid_calls_of_check_boundary(sheet, capsys):
    for options, message in (
        (["--plot", "b.png"], "--plot needs --boundary"),
        (["--boundary", "--plot", "b.txt"], "pictures are written as .png, .svg, .pdf"),
        (["--boundary", "--json", str(sheet)], "would replace an input"),
    ):
        assert run("check", sheet, *options) == 2
        assert message in capsys.readouterr().err
