"""Sliding boundaries of moved meshes and of the commands, and what is not allowed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import (
    BoundaryCurves,
    Status,
    boundary_loops,
    certify,
    distortion,
    injective_map,
    io,
    morph,
    polish,
    surfaces,
)
from quasiharmonic.geometry.curves import Curve
from quasiharmonic.io.fem.files import read_fem
from quasiharmonic.ui.cli import main
from shared.meshes import lift
from shared.simulation import quadrilaterals, second_order
from shared.sliding import SQUARE, lettered, off_the_glyph, points_of, sheared, z_of

# Moved meshes


def channel(n=14):
    """Return a channel around a square body, mapped to a rectangle, and the body rotated."""
    V, F = surfaces.annulus(n, hole=(-0.6, -0.6, 0.6, 0.6))
    walls, body = sorted(boundary_loops(F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
    turn = points_of(z_of(V[body]) * np.exp(0.5j))
    return V, F, walls, body, turn


WALLS = [Curve.polyline([(0, 0), (0, 1)]), Curve.polyline([(1, 0), (1, 1)])]


@pytest.mark.parametrize("depth", [0.124, 0.125, 0.5, 0.9])
@pytest.mark.parametrize("slide", [True, BoundaryCurves([SQUARE]), BoundaryCurves(WALLS)])
def test_nodes_of_the_walls_make_way_for_a_piston(depth, slide):
    points, F = surfaces.grid(8, 8)
    piston = np.flatnonzero(points[:, 1] == 1)
    moved = morph(points, F, piston, points[piston] - [0, depth], slide=slide)
    assert moved.success
    np.testing.assert_allclose(moved.points, points * [1, 1 - depth], atol=1e-6)


def test_elements_of_four_and_six_nodes_make_way_for_a_piston():
    places, squares = quadrilaterals(6, 6)
    curved, six = second_order(*surfaces.grid(5, 5))
    for points, F in ((places, squares), (curved, six)):
        piston = np.flatnonzero(points[:, 1] == points[:, 1].max())
        moved = morph(points, F, piston, points[piston] - [0, 0.6 * np.ptp(points[:, 1])], slide=True)
        assert moved.success
        np.testing.assert_array_equal(np.abs(moved.points[:, 0]).max(), np.abs(points[:, 0]).max())


@pytest.mark.parametrize("height", [-0.1, 0.0])
def test_walls_that_a_piston_has_left_do_not_slide(height):
    """The moved boundary crosses or touches itself, so it is no curve."""
    places, squares = quadrilaterals(4, 4)
    curved, six = second_order(*surfaces.grid(3, 3))
    for points, F in (surfaces.grid(4, 4), (places, squares), (curved, six)):
        low, high = points[:, 1].min(), points[:, 1].max()
        piston = np.flatnonzero(points[:, 1] == high)
        target = np.column_stack([points[piston, 0], np.full(piston.size, low + height)])
        for slide in (False, True):
            moved = morph(points, F, piston, target, slide=slide)
            assert moved.status is Status.IMPOSSIBLE
            np.testing.assert_array_equal(moved.points[piston], target)


def test_nodes_of_a_circle_make_way_along_it():
    """The points from -60° to 60° turn by 30°, past unmoved ones on one side, and away from them on the other."""
    V, F = surfaces.disk(10)
    V = V[:, :2]
    (loop,) = boundary_loops(F, len(V))
    moved = loop[np.abs(np.angle(z_of(V[loop]))) < np.pi / 3]
    turned = points_of(z_of(V[moved]) * np.exp(np.pi / 6 * 1j))
    result = morph(V, F, moved, turned, slide=BoundaryCurves([Curve.circle()]))
    assert result.success
    np.testing.assert_array_equal(result.points[moved], turned)
    np.testing.assert_allclose(np.linalg.norm(result.points[loop], axis=1), 1)


@pytest.mark.slow
@pytest.mark.parametrize("slide", [True, BoundaryCurves([np.array(SQUARE) * 2.0 - 1])])
def test_a_rotated_body_moves_the_wall_vertices(slide):
    V, F, walls, body, turn = channel()
    held = morph(V, F, body, turn)
    sliding = morph(V, F, body, turn, slide=slide)
    assert sliding.valid
    assert sliding.result.certificate.bijective
    assert sliding.result.history[-1].energy < 0.9 * held.result.history[-1].energy
    np.testing.assert_array_equal(sliding.points[body], turn)
    corners = walls[(np.abs(V[walls]) == 1).all(axis=1)]
    assert len(corners) == 4
    np.testing.assert_array_equal(sliding.points[corners], V[corners])
    # All vertices stay on their side, exactly, and have moved.
    for axis in (0, 1):
        side = walls[np.abs(V[walls, axis]) == 1]
        np.testing.assert_array_equal(sliding.points[side, axis], V[side, axis])
        inner = np.setdiff1d(side, corners)
        assert np.abs(sliding.points[inner] - V[inner]).max() > 0.03
        order = np.argsort(V[side, 1 - axis])
        for value in (-1, 1):
            run = side[order][V[side[order], axis] == value]
            assert (np.diff(sliding.points[run, 1 - axis]) > 0).all()


@pytest.mark.slow
def test_moved_vertices_slide_on_given_curves():
    V, F, _, body, turn = channel()
    square = points_of(z_of(np.array(SQUARE) * 1.2 - 0.6) * np.exp(0.5j))
    on = dict.fromkeys(body.tolist(), 1)
    rails = BoundaryCurves([np.array(SQUARE) * 2.0 - 1, square], on=on)
    morphed = morph(V, F, body, turn, slide=rails)
    only_walls = morph(V, F, body, turn, slide=True)
    assert morphed.result.history[-1].energy < only_walls.result.history[-1].energy
    assert rails.curves[1].nearest(morphed.points[body])[1].max() <= np.spacing(1.0)
    assert np.abs(morphed.points[body] - turn).max() > 0.01


@pytest.mark.slow
def test_a_body_close_to_a_given_wall_is_not_a_part_of_the_wall():
    V, F, walls, body, _ = channel(8)
    there, square = V[body] + (0.3997, 0.01), BoundaryCurves([np.array(SQUARE) * 2.0 - 1])
    morphed = morph(V, F, body, there, slide=square)
    assert morphed.result.certificate.bijective
    np.testing.assert_array_equal(morphed.points[body], there)
    assert np.all(np.abs(morphed.points[walls]).max(axis=1) == 1)
    loops = boundary_loops(F, len(V))
    held = BoundaryCurves(square.curves, fixed=body)
    np.testing.assert_array_equal(held.find_off_curves(loops, morphed.points), np.sort(body))
    # A loop with a vertex that the caller assigns to a curve is on it, although all are fixed.
    assert BoundaryCurves(square.curves, on={int(walls[0]): 0}, fixed=walls).find_off_curves(loops, V).size == body.size


def test_vertices_of_no_triangle_are_numbered_as_well():
    V, F, walls, body, turn = channel(8)
    V, F = np.concatenate([[(9, 9)], V]), F + 1
    on = dict.fromkeys((walls + 1).tolist(), 0)
    morphed = morph(V, F, body + 1, turn, slide=BoundaryCurves([np.array(SQUARE) * 2.0 - 1], on=on))
    assert morphed.valid
    np.testing.assert_array_equal(morphed.points[0], (9, 9))
    with pytest.raises(ValueError, match="the boundary curves refer to vertex 0, but no triangle"):
        morph(V, F, body + 1, turn, slide=BoundaryCurves([SQUARE], fixed=[0]))


# Errors


@pytest.mark.parametrize(
    ("rails", "message"),
    [
        (
            lambda loop: BoundaryCurves([SQUARE], on={int(loop[3]): 1}),
            "on refers to curve 1, but there are only curves 0 … 0",
        ),
        (lambda loop: BoundaryCurves([SQUARE], on={int(loop[3]): 0.5}), "on must contain integer"),
        (lambda loop: BoundaryCurves([]), "no curve to slide along"),
        (lambda loop: BoundaryCurves([SQUARE], corner_angle=200), "corner_angle must be between 0 and 180"),
        (lambda loop: BoundaryCurves([SQUARE], tolerance=np.nan), "tolerance must be between 0 and 1"),
        (lambda loop: BoundaryCurves([[(0, 0), (1, np.nan), (1, 1)]]), "not finite at row 1"),
        (lambda loop: BoundaryCurves([SQUARE], fixed=[0.5]), "fixed must contain integer"),
        (lambda loop: BoundaryCurves([SQUARE], fixed=[10**6]), "fixed refers to vertex 1000000"),
        (lambda loop: BoundaryCurves([SQUARE], on={10**6: 0}), "on refers to vertex 1000000"),
        (lambda loop: BoundaryCurves([SQUARE], on={60: 0}), "interior vertex 60: only boundary vertices can slide"),
        (lambda loop: BoundaryCurves([np.array(SQUARE) + 7]), "no boundary vertex is within"),
        (
            lambda loop: BoundaryCurves([Curve.polyline([(0, 0), (1, 0)])], on={int(v): 0 for v in loop}),
            "on assigns curve 0 to vertices .* the distance to it is up to 1,",
        ),
        (lambda loop: 3, "slide must be True or BoundaryCurves, not 3"),
        (lambda loop: "letter:G", "slide must be True or BoundaryCurves, not 'letter:G'"),
    ],
)
def test_invalid_boundary_curves(rails, message):
    V, F, uv, loop = sheared()
    with pytest.raises(ValueError, match=message):
        polish(V, F, uv, fixed=loop, slide=rails(loop))


def test_a_target_beyond_all_walls_is_impossible_without_a_warning():
    V, F, _, body, _ = channel(4)
    assert morph(V, F, body, 1e300 * V[body], slide=True).status is Status.IMPOSSIBLE


def test_violated_order():
    V, _, _, loop = sheared()
    lower = np.flatnonzero(V[:, 1] == 0)
    a, b = lower[np.argsort(V[lower, 0])][[3, 4]]
    swapped, met = V.copy(), V.copy()
    swapped[[a, b]] = V[[b, a]]
    met[a] = met[b]
    with pytest.raises(ValueError, match=r"vertices \(.*\), \(.*\) are neighbours on the boundary but not along"):
        BoundaryCurves([SQUARE]).lay([loop], swapped)
    with pytest.raises(ValueError, match=rf"boundary vertices \({a}, {b}\) have the same position on curve 0"):
        BoundaryCurves([SQUARE]).lay([loop], met)


def test_a_start_far_from_the_curves():
    V, F, uv, loop = sheared()
    broken = uv.copy()
    broken[5] = np.nan
    with pytest.raises(ValueError, match="not finite at vertex 5"):
        polish(V, F, broken, fixed=loop, slide=True)
    # Moving the boundary to its curve may invert triangles close to it.
    thin = uv.copy()
    low = np.flatnonzero(V[:, 1] == 0)[3]
    thin[low, 1] = -5e-4
    inner = np.setdiff1d(F[(low == F).any(axis=1)].ravel(), loop)
    thin[inner, 1] = -2.5e-4
    if certify(F, thin).injective:
        with pytest.raises(ValueError, match="with the boundary on the curves"):
            polish(V, F, thin, fixed=loop, slide=BoundaryCurves([SQUARE]))


def test_sliding_needs_an_energy():
    V, F, fixed, target, curves = lettered("letter:H")
    with pytest.raises(ValueError, match="give an energy"):
        injective_map(V, F, fixed, target, slide=BoundaryCurves(curves))


def test_a_map_that_overlaps_itself_may_slide():
    """The map is only injective: the boundary crosses itself and may continue to."""
    t = np.linspace(0, 1, 61)
    arc = np.exp(2.2j * np.pi * t)
    z = np.concatenate([arc * 1.0, arc * 1.5, arc * 2.0])
    k = np.arange(60)
    quads = [(i + r, i + r + 1, i + r + 62, i + r + 61) for r in (0, 61) for i in k]
    F = np.array([tri for a, b, c, d in quads for tri in ((a, c, b), (a, d, c))])
    uv = points_of(z)
    V = np.stack([np.tile(6.0 * t, 3), np.repeat([0.0, 0.5, 1.0], 61)], axis=1) * (1, -1)
    (loop,) = boundary_loops(F, len(V))
    start = certify(F, uv)
    if not start.injective:
        F = F[:, ::-1]
        V = V * (1, -1)
        (loop,) = boundary_loops(F, len(V))
    assert certify(F, uv).injective
    assert not certify(F, uv).bijective
    rails = BoundaryCurves([Curve.polygon(uv[loop])], on=dict.fromkeys(loop.tolist(), 0))
    result = polish(V, F, uv, fixed=loop, slide=rails, max_iterations=5)
    assert result.injective
    assert result.history[-1].energy < result.history[0].energy


# The command


@pytest.mark.slow
def test_map_slides(tmp_path):
    V, F = surfaces.random_delaunay(150, seed=2)
    _write(tmp_path / "in.obj", lift(V), F)
    energies = []
    for name, options in (("held", []), ("slid", ["--slide"])):
        call = ["map", str(tmp_path / "in.obj"), "--to", "letter:G", "--polish", "symmetric-dirichlet"]
        report = tmp_path / f"{name}.json"
        assert main([*call, *options, "-o", str(tmp_path / f"{name}.obj"), "--json", str(report)]) == 0
        facts = json.loads(report.read_text())
        assert facts["injective"]
        assert facts.get("slide", False) == bool(options)
        mesh = io.read_mesh(tmp_path / f"{name}.obj")
        energies.append(distortion(mesh.V, mesh.F, io.map_of(mesh)).statistics("symmetric_dirichlet").mean)
    assert energies[1] < energies[0]
    uv = io.map_of(io.read_mesh(tmp_path / "slid.obj"))
    (loop,) = boundary_loops(F, len(V))
    assert off_the_glyph(uv[loop], "G").max() < 1e-8
    # Continue from the result, with the outline's name and with the existing polygon.
    for options in (["--to", "letter:G"], []):
        call = ["polish", str(tmp_path / "slid.obj"), "-o", str(tmp_path / "more.obj"), "--slide", *options]
        assert main(call) == 0


def _write(path, V, F):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()] + [f"f {a} {b} {c}" for a, b, c in (F + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


def test_errors_of_the_command(tmp_path, capsys):
    _write(tmp_path / "in.obj", lift(surfaces.disk(4)[0]), surfaces.disk(4)[1])
    out = ["-o", str(tmp_path / "out.obj")]
    assert main(["map", str(tmp_path / "in.obj"), "--to", "disk", "--slide", "--no-polish", *out]) == 2
    assert "--slide needs polishing: omit --no-polish" in capsys.readouterr().err
    assert main(["map", str(tmp_path / "in.obj"), "--to", "disk", "--slide", *out]) == 0
    assert main(["polish", str(tmp_path / "out.obj"), "--to", "disk", "-o", str(tmp_path / "b.obj")]) == 2
    assert "add --slide" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_names_vertices_off_the_outline(tmp_path, capsys):
    V, F = surfaces.disk(6)
    source = tmp_path / "in.obj"
    io.write_obj(source, io.MeshData(lift(V), F).with_map(V))
    out = ["-o", str(tmp_path / "out.obj")]
    assert main(["polish", str(source), "--slide", "--to", "disk", *out]) == 0
    assert "off the outline" not in capsys.readouterr().out
    rim = boundary_loops(F, len(V))[0]
    V[rim[:3]] *= 1.01
    io.write_obj(source, io.MeshData(lift(V), F).with_map(V))
    assert main(["polish", str(source), "--slide", "--to", "disk", *out]) == 0
    named = ", ".join(map(str, rim[:3]))
    assert (
        f"3 of {len(rim)} boundary vertices are off the outline and stay fixed: vertices {named}"
        in capsys.readouterr().out
    )


@pytest.mark.slow
def test_vertices_have_given_sides(tmp_path, capsys):
    V, F = surfaces.grid(10, 10)
    # With the diagonal before the corner (1, 0) flipped, there is space beside it for the next vertex of the right
    # side, which is closer to the lower one.
    F[18:20] = (9, 10, 21), (9, 21, 20)
    uv, moved = V.copy(), 21
    uv[moved] = 0.9995, 0.0004
    io.write_obj(tmp_path / "in.obj", io.MeshData(lift(V), F).with_map(uv))
    pieces, out = tmp_path / "sides.txt", tmp_path / "out.obj"
    call = ["polish", str(tmp_path / "in.obj"), "--to", "rect:1x1", "--slide", "-o", str(out)]
    assert main(call) == 2
    assert "assign vertices to curves" in capsys.readouterr().err
    pieces.write_text(f"# the right side is the second\n\n{moved}, 1\n")
    assert main([*call, "--pieces", str(pieces)]) == 0
    found = io.map_of(io.read_mesh(out))
    assert found[moved, 0] == 1
    assert found[moved, 1] > 0.05
    # The same for a new map.
    right = np.flatnonzero(V[:, 0] == 1)
    pieces.write_text("".join(f"{v} 1\n" for v in right))
    corners = [int(np.flatnonzero((place == V).all(axis=1))[0]) for place in SQUARE]
    call = ["map", str(tmp_path / "in.obj"), "--to", "rect:2x1", "--corners", ",".join(map(str, corners))]
    call += ["-o", str(out)]
    assert main([*call, "--slide", "--pieces", str(pieces)]) == 0
    assert (io.map_of(io.read_mesh(out))[right, 0] == 2).all()
    pieces.write_text("".join(f"{v} 3\n" for v in right))
    assert main([*call, "--slide", "--pieces", str(pieces)]) == 2
    assert (
        "on assigns curve 3 to vertices 10, 21, 32, 43, 54, … (11 in all), but the distance to it is up to 2"
        in capsys.readouterr().err
    )
    for text, message in (
        ("3 4", "says side 4, but the outline has only sides 0 … 3 at line 1"),
        ("3", "is not 'vertex side'"),
        ("-3 1", "is not 'vertex side'"),
        ("3 1\n3 1", "lists vertex 3 a second time at line 2"),
        ("9999 1", "on refers to vertex 9999"),
    ):
        pieces.write_text(text)
        assert main([*call, "--slide", "--pieces", str(pieces)]) == 2
        assert message in capsys.readouterr().err
    assert main([*call, "--pieces", str(pieces)]) == 2
    assert "add --slide and --to" in capsys.readouterr().err
    assert main([*call, "--slide", "--pieces", str(tmp_path / "none")]) == 2
    assert "there is no such file" in capsys.readouterr().err


@pytest.mark.slow
def test_morph_slides(tmp_path):
    V, F, walls, body, turn = channel(10)
    shift = np.zeros((len(V), 3))
    shift[body, :2] = turn - V[body]
    lines = ["# vtk DataFile Version 3.0", "a channel", "ASCII", "DATASET UNSTRUCTURED_GRID", f"POINTS {len(V)} double"]
    lines += [f"{x!r} {y!r} 0" for x, y in V.tolist()]
    lines += [f"CELLS {len(F)} {4 * len(F)}", *(f"3 {a} {b} {c}" for a, b, c in F.tolist())]
    lines += [f"CELL_TYPES {len(F)}", *["5"] * len(F), f"POINT_DATA {len(V)}", "VECTORS displacement double"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in shift.tolist()]
    (tmp_path / "in.vtk").write_text("\n".join(lines) + "\n")
    call = ["morph", str(tmp_path / "in.vtk"), "--field", "displacement", "--slide", "-o", str(tmp_path / "out.vtk")]
    assert main(call) == 0
    after = read_fem(tmp_path / "out.vtk").points
    # The field moves the walls by zero, so they slide.
    np.testing.assert_array_equal(after, morph(V, F, body, V[body] + shift[body, :2], slide=True).points)
    assert np.abs(after[walls] - V[walls]).max() > 0.03
    assert (np.abs(after[walls]).max(axis=1) == 1).all()
    assert main([*call, "--no-polish"]) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"curves": None}, "curves must be a Curve, a polygon"),
        ({"curves": [SQUARE], "on": [1, 2]}, "on must map vertices to curves"),
    ],
)
def test_invalid_curves(arguments, words):
    with pytest.raises(ValueError, match=words):
        BoundaryCurves(**arguments)
