"""Repair of maps with inverted triangles: what changes, what does not, and what is reported."""

from __future__ import annotations

import json

import numpy as np
import pytest

from quasiharmonic import distortion, inverted_triangles, io, repair
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from shared.commands import run
from shared.exact import exact_orientation
from shared.meshes import bend, boundary_of, lift, signed_areas
from shared.seam_meshes import islands, strips


def damaged(uv, inner, count, scale, seed=0):
    """Return a map with some displaced interior positions, and these."""
    rng = np.random.default_rng(seed)
    pushed = rng.choice(inner, count, replace=False)
    uv = uv.copy()
    uv[pushed] += rng.normal(0, scale, (count, 2))
    return uv, pushed


def inner_rows(FT, rows=slice(None)):
    """Return rows of texture coordinates that are not on the boundary of the triangles' islands."""
    return np.setdiff1d(FT[rows], boundary_of(FT[rows]))


def exact_signs(uv, FT):
    """Return the orientation of every triangle in exact arithmetic."""
    return np.array([exact_orientation(*corners) for corners in uv[FT]])


class TestRepair:
    def test_fixed_vertices_keep_their_positions(self):
        V, F = random_delaunay(400, seed=2)
        start, pushed = damaged(bend(V), inner_rows(F), 1, 0.1, seed=3)
        assert inverted_triangles(F, start).size
        result = repair(lift(V), F, start, fixed=pushed)
        assert result.injective, "the vertices around it move in its place"
        assert np.array_equal(result.uv[pushed], start[pushed])
        for wrong, message in (
            ([400], "fixed refers to vertex 400"),
            ([-1], "fixed refers to vertex -1"),
            ([[0]], "fixed must have shape"),
        ):
            with pytest.raises(ValueError, match=message):
                repair(V, F, start, fixed=wrong)

    @pytest.mark.slow
    @pytest.mark.parametrize(("count", "scale"), [(1, 0.4), (12, 0.05), (12, 0.4), (120, 0.05)])
    def test_only_displaced_vertices_move(self, count, scale):
        V, F = random_delaunay(400, seed=2)
        uv = bend(V)
        start, pushed = damaged(uv, inner_rows(F), count, scale)
        flips = inverted_triangles(F, start)
        assert flips.size
        result = repair(lift(V), F, start)
        (island,) = result.islands
        assert result.injective
        assert island.bijective
        assert exact_signs(result.uv, F).min() == 1
        assert np.array_equal(island.inverted_before, flips)
        assert np.array_equal(result.moved_vertices, np.flatnonzero((result.uv != start).any(axis=1)))
        # Almost no other vertex must move.
        assert len(np.setdiff1d(result.moved_vertices, pushed)) <= count // 20
        assert np.array_equal(result.FT, F)

    @pytest.mark.slow
    def test_no_vertex_moves_without_need(self):
        V, F = random_delaunay(400, seed=2)
        start, _ = damaged(V, inner_rows(F), 30, 0.1)
        result = repair(V, F, start)
        assert result.injective
        distances = np.linalg.norm(result.uv - start, axis=1)
        assert distances[result.moved_vertices].min() > 0
        # Patches are polished: no triangle around moved vertices stays almost flat.
        around = np.isin(F, result.moved_vertices).any(axis=1)
        assert signed_areas(F, result.uv)[around].min() > 1e-3 * np.median(signed_areas(F, V))

    def test_inputs_do_not_change_and_results_repeat(self):
        V, F = random_delaunay(100, seed=2)
        start, _ = damaged(V, inner_rows(F), 8, 0.2)
        arrays = V.astype(np.float32), F.astype(np.uint16), start
        before = [a.copy() for a in arrays]
        one, other = repair(*arrays), repair(*arrays)
        assert all(np.array_equal(a, b) for a, b in zip(arrays, before, strict=True))
        assert np.array_equal(one.uv, other.uv)
        assert one.injective

    def test_nothing_to_repair(self):
        V, F, uv, FT, _ = strips(3)
        result = repair(V, F, uv, FT=FT)
        assert np.array_equal(result.uv, uv)
        assert np.array_equal(result.FT, FT)
        assert result.injective
        assert result.moved_vertices.size == 0
        assert result.summary() == "3 islands: 0 triangles inverted before, 0 now; 0 vertices moved"

    def test_islands_one_by_one(self):
        V, F, uv, FT, strip = strips()
        start, pushed = damaged(uv, inner_rows(FT, strip == 1), 10, 0.1)
        result = repair(V, F, start, FT=FT)
        assert result.injective
        assert [len(island.moved_vertices) > 0 for island in result.islands] == [False, True, False]
        assert exact_signs(result.uv, result.FT).min() == 1
        changed = np.flatnonzero((result.uv != start).any(axis=1))
        assert len(result.uv) == len(start)
        assert len(np.setdiff1d(changed, pushed)) <= 1
        assert np.array_equal(result.FT, FT)
        # Rows of coordinates and vertices of the mesh have different numbers.
        assert np.array_equal(result.islands[1].moved_vertices, np.unique(F[np.isin(FT, changed)]))

    def test_whole_islands_on_request(self):
        V, F, uv, FT, strip = strips()
        start, _ = damaged(uv, inner_rows(FT, strip == 1), 10, 0.1)
        result = repair(V, F, start, FT=FT, whole=True)
        assert result.injective
        changed = np.flatnonzero((result.uv != start).any(axis=1))
        assert np.array_equal(changed, inner_rows(FT, strip == 1))

    @pytest.mark.slow
    def test_texture_coordinates_per_corner(self):
        V, F = random_delaunay(100, seed=2)
        start, _ = damaged(V, inner_rows(F), 5, 0.2)
        result = repair(V, F, start[F.ravel()], FT=np.arange(F.size).reshape(-1, 3))
        whole = repair(V, F, start)
        assert result.injective
        assert len(result.uv) == F.size
        np.testing.assert_array_equal(result.uv, whole.uv[F.ravel()])

    def test_stacked_islands(self):
        """Sheets that share texture coordinates stay together where both move equally, and separate elsewhere."""
        plane, F = grid(6, 6)
        uv = plane.copy()
        uv[24] += 0.3
        stacked = np.concatenate([F, F + len(plane)])
        FT = np.concatenate([F, F])
        alike = np.concatenate([np.column_stack([plane, np.full(len(plane), height)]) for height in (0.0, 5.0)])
        result = repair(alike, stacked, uv, FT=FT)
        assert result.injective
        assert np.array_equal(result.FT, FT)
        assert np.flatnonzero((result.uv != uv).any(axis=1)).tolist() == [24]
        unlike = alike + (np.arange(len(alike)) >= len(plane))[:, None] * np.array([[1.0, 2.0, 0.0]]) * alike**2
        result = repair(unlike, stacked, uv, FT=FT)
        assert result.injective
        assert np.array_equal(result.uv[:49], uv)
        assert len(result.uv) == 51
        assert np.array_equal(result.FT, np.where(FT == 24, [[49]] * len(F) + [[50]] * len(F), FT))
        assert len(islands(stacked, result.uv, result.FT)) == 2

    def test_rows_used_by_other_triangles_do_not_change(self):
        """A vertex that moves, and a separate triangle that uses its row, too."""
        plane, F = grid(6, 6)
        uv = plane.copy()
        uv[24] += 0.3
        V = np.concatenate([lift(plane), [[5, 0, 0], [6, 0, 0], [5, 1, 0]]])
        far = np.array([[49, 50, 51]])
        lonely = np.array([[0, 6, 24]])
        assert exact_signs(uv, lonely)[0] == 1
        result = repair(V, np.concatenate([F, far]), uv, FT=np.concatenate([F, lonely]))
        assert result.injective
        assert np.array_equal(result.uv[24], uv[24])
        assert np.array_equal(result.FT[-1], lonely[0])
        assert len(result.uv) == 50
        assert np.array_equal(result.FT[:-1], np.where(F == 24, 49, F))
        assert len(islands(np.concatenate([F, far]), result.uv, result.FT)) == 2
        assert exact_signs(result.uv, result.FT).min() == 1

    def test_interior_vertices_may_have_no_position(self):
        V, F = random_delaunay(200, seed=2)
        start = V.copy()
        lost = inner_rows(F)[[3, 40, 41]]
        start[lost] = [[np.nan, 0], [1e67, -1e67], [np.inf, np.nan]]
        result = repair(V, F, start)
        assert result.injective
        assert np.array_equal(result.moved_vertices, lost)

    def test_a_surface_with_a_hole_is_repaired(self):
        V, F = annulus(12)
        start, _ = damaged(V, inner_rows(F), 30, 0.2)
        result = repair(V, F, start)
        assert result.injective
        assert result.islands[0].bijective
        assert np.array_equal(result.uv[boundary_of(F)], V[boundary_of(F)])

    @pytest.mark.slow
    def test_boundary_that_crosses_itself(self):
        """A map without inverted triangles exists and is found; its overlap is reported."""
        V, F = grid(60, 4)
        angle, radius = -2.4 * np.pi * V[:, 0], 2 + V[:, 1]
        wound = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        start, _ = damaged(wound, inner_rows(F), 6, 0.4)
        assert inverted_triangles(F, start).size
        result = repair(V, F, start)
        assert result.injective
        assert not result.islands[0].bijective
        assert "it overlaps itself" in result.summary()

    def test_flat_rest_triangles_do_no_harm(self):
        V, F = grid(8, 8)
        start, _ = damaged(V, inner_rows(F), 4, 0.3)
        assert repair(np.zeros_like(V), F, start).injective

    def test_an_interrupt_of_the_callback_is_raised(self):
        V, F = random_delaunay(100, seed=2)
        start, _ = damaged(V, inner_rows(F), 5, 0.3)

        def interrupt(step):
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            repair(V, F, start, callback=interrupt)

    def test_invalid_input_is_named(self):
        V, F = grid(3, 3)
        with pytest.raises(ValueError, match=r"V must have shape \(n, 2\) or \(n, 3\), not"):
            repair(V[:, :1], F, V)
        with pytest.raises(ValueError, match="F refers to vertex 15, but there are only vertices 0 … 14"):
            repair(V[:-1], F, V)
        with pytest.raises(ValueError, match="max_iterations"):
            repair(V, F, V, max_iterations=0)


class TestBeyondRepair:
    def test_the_boundary_alone_inverts_a_triangle(self):
        """The rest is repaired, and the reason names elements by the mesh's numbers."""
        V, F, uv, FT, strip = strips()
        # An ear of the last strip: a triangle with two boundary edges, folded inwards.
        ear = np.array([[0, 1, 2]]) + len(V)
        V = np.concatenate([V, V[:3] + 9, V[:1] + 8])
        corner = len(uv)
        uv = np.concatenate([uv, [[20, 0], [21, 0], [20, 1], [20.4, 0.2]]])
        F = np.concatenate([F, ear, ear[:, (2, 1, 0)] * [1, 1, 0] + [0, 0, len(V) - 1]])
        FT = np.concatenate([FT, [[corner, corner + 1, corner + 2], [corner + 2, corner + 1, corner + 3]]])
        start, _ = damaged(uv, inner_rows(FT, np.append(strip == 0, [False, False])), 5, 0.1)
        result = repair(V, F, start, FT=FT)
        assert not result.injective
        assert [island.injective for island in result.islands] == [True, True, True, False]
        last = result.islands[-1]
        assert last.inverted.tolist() == [len(F) - 1]
        assert last.moved_vertices.size == 0
        assert last.diagnosis.forbids_injective
        (obstruction,) = (o for o in last.diagnosis.obstructions if o.triangles.size)
        assert obstruction.triangles.tolist() == [len(F) - 1]
        assert set(obstruction.vertices.tolist()) <= set(F[-1].tolist())
        assert f"triangle {len(F) - 1}" in last.reason
        assert f"triangle {len(F) - 1} left" in result.summary()

    def test_an_inverted_ear_does_not_prevent_other_repairs(self):
        V, F = grid(8, 8)
        ear = np.array([[4, 3, len(V)]])  # below the bottom side, folded up
        F = np.concatenate([F, ear])
        uv = np.concatenate([V, [[0.44, 0.05]]])
        start, _ = damaged(uv, inner_rows(F), 6, 0.2)
        result = repair(np.concatenate([V, [[0.44, -0.1]]]), F, start)
        assert result.islands[0].inverted.tolist() == [len(F) - 1]
        assert "edge" in result.islands[0].reason or "triangle" in result.islands[0].reason

    def test_mirrored(self):
        V, F, uv, FT, strip = strips(4)
        rows = np.unique(FT[strip == 2])
        uv[rows] *= [-1, 1]
        result = repair(V, F, uv, FT=FT)
        assert [island.mirrored for island in result.islands] == [False, False, True]
        assert result.injective
        assert "mirrored, left unchanged" in result.summary()
        assert np.array_equal(result.uv, uv)

    def test_mirrored_and_reversed(self):
        V, F, uv, FT, strip = strips(4)
        rows = np.unique(FT[strip == 2])
        uv[rows] *= [-1, 1]
        result = repair(V, F, uv, FT=FT, unmirror=True)
        assert result.injective
        assert not inverted_triangles(result.FT, result.uv).size
        assert np.array_equal(result.uv[FT[strip != 2]], uv[FT[strip != 2]])
        # In the same box.
        for pick in (np.min, np.max):
            np.testing.assert_allclose(pick(result.uv[rows], axis=0), pick(uv[rows], axis=0))

    def test_a_single_island_that_is_mirrored_is_inverted(self):
        V, F = grid(4, 4)
        result = repair(V, F, V * [-1, 1])
        assert not result.injective
        assert [o.kind.name for o in result.islands[0].diagnosis.obstructions] == ["REVERSED"]
        assert repair(V, F, V * [-1, 1], unmirror=True).injective

    def test_closed_surface(self):
        F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
        result = repair(np.eye(4)[:, :3], F, [[0, 0], [1, 0], [0, 1], [0.2, 0.2]])
        assert not result.injective
        assert "closed" in result.islands[0].reason

    def test_boundary_without_positions(self):
        V, F = grid(3, 3)
        uv = V.copy()
        uv[2] = np.nan
        result = repair(V, F, uv)
        assert not result.injective
        assert result.islands[0].reason == (
            "No finite position for the boundary vertex 2. Give it one, or flatten the island again."
        )

    def test_vertex_used_twice(self):
        V, F = grid(3, 3)
        F = np.concatenate([F, [[0, 0, 1]]])
        result = repair(V, F, V)
        assert result.islands[-1].reason == (
            f"A vertex is used twice in triangle {len(F) - 1}. Remove such triangles with clean."
        )

    def test_the_result_of_an_undefined_map_is_valid_json(self):
        V, F = grid(3, 3)
        uv = V.copy()
        uv[2] = np.nan
        assert json.loads(json.dumps(repair(V, F, uv).to_dict(), allow_nan=False))["injective"] is False


@pytest.fixture
def uv_file(tmp_path):
    """Write an atlas with inverted triangles in two islands, as another program might."""
    V, F, uv, FT, strip = strips(8)
    start, _ = damaged(uv, inner_rows(FT, strip == 0), 6, 0.1)
    start, _ = damaged(start, inner_rows(FT, strip == 2), 3, 0.2, seed=1)
    lines = ["# an atlas", "mtllib some.mtl", "o curved"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()]
    lines += [f"vt {u!r} {v!r}" for u, v in start.tolist()]
    lines += ["vn 0 0 1", "s off"]
    for k in range(3):
        lines += [f"g strip_{k}", "usemtl cloth"]
        for corners in np.stack([F, FT], axis=2)[strip == k] + 1:
            lines.append("f " + " ".join(f"{v}/{t}/1" for v, t in corners.tolist()))
    path = tmp_path / "atlas.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


class TestCommand:
    def test_file_with_seams(self, uv_file, tmp_path, capsys):
        out, report = tmp_path / "repaired.obj", tmp_path / "report.json"
        assert run("repair", uv_file, "-o", out, "--json", report) == 0
        before, after = uv_file.read_text().splitlines(), out.read_text().splitlines()
        changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
        facts = json.loads(report.read_text())
        assert 0 < len(changed) == facts["moved_vertices"]
        assert all(a.startswith("vt ") and b.startswith("vt ") for a, b in changed)
        mesh, written = io.read_obj(uv_file), io.read_obj(out)
        assert exact_signs(mesh.vt, mesh.FT).min() == -1
        assert exact_signs(written.vt, written.FT).min() == 1
        assert facts["injective"] is True
        assert facts["inverted"] == 0
        assert [len(island["moved_vertices"]) > 0 for island in facts["islands"]] == [True, False, True]
        said = capsys.readouterr()
        assert f"wrote {out}: 3 islands: {facts['inverted_before']} triangles inverted before, 0 now" in said.out
        assert said.err == ""

    @pytest.mark.long
    def test_the_other_commands_accept_seams(self, uv_file, tmp_path, capsys):
        out, report, faces = tmp_path / "repaired.obj", tmp_path / "report.json", tmp_path / "faces.npz"
        assert run("check", uv_file, "--json", report) == 1
        mesh = io.read_obj(uv_file)
        wrong = np.flatnonzero(exact_signs(mesh.vt, mesh.FT) <= 0)
        assert json.loads(report.read_text())["inverted"] == wrong.tolist()
        assert run("repair", uv_file, "-o", out) == 0
        capsys.readouterr()
        assert run("check", out) == 0
        assert f"vertices from {len(mesh.V)} on are copies of vertices" in capsys.readouterr().out
        assert run("measure", out, "--export", faces) == 0
        # The same, corner by corner: no triangle shares anything with another.
        written = io.read_obj(out)
        apart = np.arange(mesh.F.size).reshape(-1, 3)
        expected = distortion(written.V[written.F].reshape(-1, 3), apart, written.vt[written.FT].reshape(-1, 2))
        with np.load(faces) as file:
            assert file["uv"][file["F"]].tolist() == written.vt[written.FT].tolist()
            assert file["isometric"] == pytest.approx(expected.isometric)
        for kind in ("map", "distortion", "texture"):
            assert run("plot", out, "-o", tmp_path / f"{kind}.png", "--kind", kind) == 0

    def test_a_file_is_repaired_in_place(self, uv_file):
        assert run("repair", uv_file, "-o", uv_file) == 0
        repaired = uv_file.read_bytes()
        assert run("repair", uv_file, "-o", uv_file) == 0
        assert uv_file.read_bytes() == repaired

    @pytest.mark.slow
    def test_check_agrees_where_there_are_no_seams(self, tmp_path, capsys):
        V, F = random_delaunay(200, seed=2)
        start, _ = damaged(V, inner_rows(F), 10, 0.2)
        path, out = tmp_path / "map.obj", tmp_path / "out.obj"
        io.write_obj(path, io.MeshData(lift(V), F).with_map(start))
        assert run("check", path) == 1
        assert run("repair", path, "-o", out) == 0
        assert run("check", out) == 0
        assert run("repair", path, "-o", out, "--whole") == 0
        assert run("check", out) == 0
        assert (io.map_of(io.read_obj(out)) != start).any(axis=1).sum() == len(inner_rows(F))
        capsys.readouterr()

    def test_messages_use_the_singular(self, tmp_path, capsys):
        V, F = disk(3)
        start = V.copy()
        start[0] = [0.4, 0.1]
        path, out = tmp_path / "map.obj", tmp_path / "out.obj"
        io.write_obj(path, io.MeshData(lift(V), F).with_map(start))
        assert run("repair", path, "-o", out) == 0
        first, island = capsys.readouterr().out.splitlines()
        assert first.endswith(" triangles inverted before, 0 now; 1 vertex moved")
        assert island.endswith(" inverted before, 0 now; 1 vertex moved")

    def test_status_1_if_inverted_triangles_remain(self, tmp_path, capsys):
        V, F = grid(4, 4)
        path, out = tmp_path / "map.obj", tmp_path / "out.obj"
        io.write_obj(path, io.MeshData(V, F).with_map(V[:, ::-1]))
        assert run("repair", path, "-o", out) == 1
        said = capsys.readouterr().out
        assert "32 inverted before, 32 now; 0 vertices moved" in said
        assert "has the opposite orientation to the mesh" in said
        assert np.array_equal(io.map_of(io.read_obj(out)), V[:, ::-1])

    @pytest.mark.parametrize(
        ("text", "output", "message"),
        [
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "out.obj", "no face has texture coordinates"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3\n", "out.obj", "at all three corners"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 4 2\n", "out.obj", "uses a vertex twice"),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "out.off", ".off files cannot store seams"),
            (None, "out.obj", "there is no such file"),
        ],
    )
    def test_status_2_and_nothing_written(self, text, output, message, tmp_path, capsys):
        path = tmp_path / "in.obj"
        if text is not None:
            path.write_text(text)
        assert run("repair", path, "-o", tmp_path / output) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / output).exists()

    def test_faces_without_a_map_do_not_change(self, uv_file, tmp_path, capsys):
        uv_file.write_text(uv_file.read_text() + "f 1 2 3\n")
        out = tmp_path / "out.obj"
        assert run("repair", uv_file, "-o", out) == 0
        assert out.read_text().endswith("f 1 2 3\n")
        capsys.readouterr()
