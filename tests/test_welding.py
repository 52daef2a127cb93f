"""Welding within a distance: `clean`, `inspect_mesh`, `unwrap`, `flatten`, maps with seams, and ``--weld``."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import atlas, certify, clean, flatten, inspect_mesh, io, unwrap
from quasiharmonic.geometry.mesh.splitting import find_representatives
from quasiharmonic.io import MeshData
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main
from shared.cleaning import cube, soup
from shared.examples import examples

FUNCTIONS = clean, inspect_mesh, unwrap, flatten


def noisy_soup(V, F, noise=1e-9):
    """The same triangles, each with vertices of its own that are almost at their positions."""
    V, F = soup(V, F)
    return V + noise * np.random.default_rng(0).uniform(-1, 1, V.shape), F


def bowl(rings=4):
    V, F = disk(rings)
    return np.column_stack([V, 0.3 * V[:, 0] ** 2]), F


def find_by_loops(V, F, weld):
    """Representatives by comparing all pairs; also whether a distance is too close to the limit for certainty."""
    used = sorted(set(np.ravel(F).tolist()))
    V = np.longdouble(V)
    length = np.sqrt((np.ptp(V[used], axis=0) ** 2).sum())
    joint, chosen, unsure = list(range(len(V))), [], False
    for i in used:
        apart = [np.sqrt(((V[i] - V[j]) ** 2).sum()) for j in chosen]
        limit = weld * length
        unsure |= any(abs(one - limit) < 1e-9 * length * (weld > 0) for one in apart)
        close = [j for j, one in zip(chosen, apart, strict=True) if one <= limit]
        if close:
            joint[i] = close[0]
        else:
            chosen.append(i)
    return joint, unsure


@pytest.mark.slow
@given(
    st.integers(3, 40),
    st.integers(2, 3),
    st.sampled_from([0, 1e-12, 1e-3, 0.05, 0.2, 0.5, 2]),
    st.sampled_from([1, 1e150, 1e-150]),
    st.integers(0, 2**31),
)
@examples(150)
def test_representatives_are_those_of_a_comparison_of_all_pairs(n, dimension, weld, scale, seed):
    rng = np.random.default_rng(seed)
    V = rng.integers(3, size=(n, dimension)) + 1e-3 * rng.integers(2, size=(n, dimension)) * rng.normal(size=(n, 1))
    F = rng.integers(n, size=(n // 2 + 1, 3))
    expected, unsure = find_by_loops(V, F, weld)
    if not unsure:
        assert find_representatives(scale * V, F, weld).tolist() == expected


def test_a_chain_is_not_welded_beyond_the_distance():
    # Along the line, neighbours have distance 1 and the bounding box has a diagonal of 100.
    V = np.array([[float(k), 0, 0] for k in range(7)] + [[0, 100, 0]])
    V[7, 1] = np.sqrt(100**2 - 6**2)
    F = np.array([[0, 1, 7], [1, 2, 7], [2, 3, 7], [3, 4, 7], [4, 5, 7], [5, 6, 7]])
    assert find_representatives(V, F, 0.0101).tolist() == [0, 0, 2, 2, 4, 4, 6, 7]
    assert find_representatives(V, F, 0.0201).tolist() == [0, 0, 0, 3, 3, 3, 6, 7]
    assert find_representatives(V, F, 0.0099).tolist() == list(range(8))
    # The order decides which vertices are representatives.
    assert find_representatives(V[[1, 0, 2, 3, 4, 5, 6, 7]], F, 0.0101).tolist() == [0, 0, 0, 3, 3, 5, 5, 7]


def test_ties_go_to_the_lowest_index():
    # Vertex 2 is exactly in the middle between 0 and 1, and vertex 3 between 1 and 0.
    V = np.array([[0.0, 0], [2, 0], [1, 0], [1, 0], [0, 64]])
    F = np.array([[0, 1, 4], [2, 3, 4]])
    assert find_representatives(V, F, 0.016).tolist() == [0, 1, 0, 0, 4]
    assert find_representatives(V[[1, 0, 2, 3, 4]], F, 0.016).tolist() == [0, 1, 0, 0, 4]


def test_vertices_without_triangle_have_no_effect():
    V = np.array([[0.0, 0], [0, 0], [1, 0], [0, 1], [1e-7, 0], [1e9, 0]])
    assert find_representatives(V, np.array([[1, 2, 3], [4, 3, 2]]), 1e-6).tolist() == [0, 1, 2, 3, 1, 5]


def test_tiny_distances_between_large_positions_do_not_underflow():
    V = np.array([[0.0, 0], [1, 0], [0, 1], [1e-200, 0], [1e-250, 0], [-0.0, 0]])
    F = np.array([[0, 1, 2], [3, 4, 5]])
    assert find_representatives(V, F, 1e-300).tolist() == [0, 1, 2, 3, 4, 0]
    assert find_representatives(V, F, 1e-220).tolist() == [0, 1, 2, 3, 0, 0]
    assert find_representatives(V, F, 1e-190).tolist() == [0, 1, 2, 0, 0, 0]


@pytest.mark.parametrize("scale", [1, 1e-150, 1e150, 1e-300, 1e300])
def test_clean_welds_a_noisy_soup(scale):
    V, F = bowl()
    S, G = noisy_soup(V, F)
    cleaned = clean(scale * S, G, weld=1e-6)
    assert (len(cleaned.V), cleaned.facing.size) == (len(V), 1)
    assert np.array_equal(cleaned.V, scale * S[cleaned.representatives[cleaned.vertices]])
    assert (cleaned.representatives <= np.arange(len(S))).all()
    assert cleaned.changes["vertices merged"].size == len(S) - len(V)
    assert np.array_equal(cleaned.restore_corners(cleaned.corners), G)
    for weld in (True, False, 0, 1e-12):
        assert clean(scale * S, G, weld=weld).facing.size == len(F)


@pytest.mark.parametrize("weld", [0, 0.0, np.float32(0), 1e-9, np.float64(1e-9)])
def test_a_small_distance_welds_equal_positions_like_true(weld):
    V, F = bowl()
    expected, cleaned = clean(*soup(V, F)), clean(*soup(V, F), weld=weld)
    assert np.array_equal(cleaned.F, expected.F)
    assert np.array_equal(cleaned.V, expected.V)
    assert np.array_equal(cleaned.representatives, expected.representatives)


def test_triangles_that_welding_collapses_are_excluded_and_reported():
    V, F = disk(3)
    # Divide a triangle by a point close to one of its corners.
    a, b, c = F[4]
    W = np.concatenate([V, [V[a] + 1e-5 * (V[b] + V[c] - 2 * V[a])]])
    n = len(V)
    G = np.concatenate([np.delete(F, 4, axis=0), [[a, b, n], [b, c, n], [c, a, n]]])
    assert not clean(W, G, weld=1e-9).collapsed.size
    cleaned = clean(W, G, weld=1e-3)
    assert cleaned.collapsed.tolist() == cleaned.excluded.tolist() == [len(F) - 1, len(F) + 1]
    assert f"triangles collapsed by welding         2  {len(F) - 1}, {len(F) + 1}" in cleaned.summary()
    result = unwrap(W, G, weld=1e-3, resolution=256)
    assert result.success
    assert result.indices.shape == G.shape
    assert f"neighbour: triangles {len(F) - 1}, {len(F) + 1}" in result.summary()
    assert result.to_dict()["collapsed"] == [len(F) - 1, len(F) + 1]
    with pytest.raises(ValueError, match=rf"merges corners of triangles {len(F) - 1}, {len(F) + 1}: choose a smaller"):
        flatten(W, G, weld=1e-3)
    assert inspect_mesh(W, G, weld=1e-3).defects["triangles that use a vertex twice"].tolist() == [
        len(F) - 1,
        len(F) + 1,
    ]
    # A triangle with equal corners has no area without welding, too.
    assert not clean(np.concatenate([V, V[:1]]), [*F.tolist(), [0, n, 1]], weld=1e-9).collapsed.size


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("weld", [-1, -1e-9, np.nan, np.inf, "yes", None, [1e-6]])
def test_a_wrong_distance_is_an_error(function, weld):
    with pytest.raises(ValueError, match="weld must be True, False, or a distance"):
        function(*bowl(2), weld=weld)


@pytest.mark.parametrize("function", [clean, unwrap, flatten])
@pytest.mark.parametrize("weld", [0.9, 1, 1e300])
def test_a_mesh_that_collapses_as_a_whole_is_an_error(function, weld):
    with pytest.raises(ValueError, match=r"welding at distance .* merges corners of .* a smaller distance"):
        function(np.array([[0.0, 0], [1, 0], [0, 1]]), [[0, 1, 2]], weld=weld)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_positions_that_are_not_finite_are_an_error(function):
    V, F = bowl(2)
    V[3] = np.nan
    with pytest.raises(ValueError, match="not finite at vertex 3"):
        function(V, F, weld=1e-6)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_arrays_of_any_type_stay_unchanged(function):
    V, F = soup(*disk(3))
    for W, G in ((np.rint(1000 * V).astype(np.int32), F.astype(np.uint16)), (V.astype(np.float32), F.astype(np.int32))):
        before = W.copy(), G.copy()
        result = function(W, G, weld=1e-6)
        assert np.array_equal(W, before[0])
        assert np.array_equal(G, before[1])
        if function is clean:
            assert len(result.V) == len(disk(3)[0])


def test_non_manifold_edges_stay_separated_after_welding():
    """Two cubes with almost a common edge."""
    (V, F), (W, G) = cube(), cube((1, 1, 1e-9))
    V, F = np.concatenate([V, W]), np.concatenate([F, G + 8])
    cleaned = clean(V, F, weld=1e-6)
    assert np.array_equal(cleaned.F, F)
    assert cleaned.facing.tolist() == [1, 1]
    report = inspect_mesh(V, F, weld=1e-6)
    assert len(report.defects["edges of three or more triangles"]) == 1
    assert report.welded.tolist() == [8, 9]


def test_inspection_of_the_welded_mesh_keeps_the_numbering():
    V, F = bowl()
    S, G = noisy_soup(V, F)
    # Vertex 0 is unused, the last two are an exact copy of another and a copy that no triangle uses.
    S, G = np.concatenate([[[9.0, 9, 9]], S, S[-1:], S[:1]]), G + 1
    G[-1, 2] = len(S) - 2
    before, report = inspect_mesh(S, G), inspect_mesh(S, G, weld=1e-6)
    assert (before.components, report.components, report.loops, report.vertices) == (len(F), 1, 1, len(S))
    assert report.defects["vertices without triangle"].tolist() == [0, len(S) - 3, len(S) - 1]
    assert report.welded.size == len(G) * 3 - len(V)
    assert report.to_dict()["welded_vertices"] == report.welded.tolist()
    assert f"{report.welded.size} vertices welded to an earlier vertex" in report.summary()
    assert before.close.size
    assert not report.close.size
    assert not before.welded.size


def test_unwrap_keeps_the_numbering_and_lists_each_seam_once():
    V, F = cube()
    S, G = noisy_soup(V, F)
    result, expected = unwrap(S, G, weld=1e-6, resolution=256), unwrap(V, F, resolution=256)
    assert result.success
    assert np.array_equal(result.vmapping[result.indices], G)
    assert (result.n_charts, len(result.seams)) == (expected.n_charts, len(expected.seams))
    assert unwrap(S, G, resolution=256).n_charts == len(F)


def test_flatten_welds_and_keeps_the_numbering():
    V, F = bowl()
    S, G = noisy_soup(V, F)
    result, expected = flatten(S, G, weld=1e-6, record_every=1), flatten(V, F, record_every=1)
    joint = find_representatives(S, G, 1e-6)
    assert result.certificate.bijective
    assert result.uv.shape == (len(S), 2)
    assert np.array_equal(result.uv, result.uv[joint])
    assert np.array_equal(result.F, joint[G])
    assert np.isclose(result.history[-1].energy, expected.history[-1].energy, rtol=1e-5)
    assert len(result.path) == len(expected.path)
    assert all(np.array_equal(step.uv, step.uv[joint]) for step in result.path)
    assert certify(joint[G], result.path[-1].uv).bijective
    # By default, nothing is welded.
    assert len(flatten(S, G).certificate.F) == len(F)
    assert not np.array_equal(flatten(S, G).uv, flatten(S, G).uv[joint])


def test_flatten_welds_each_of_several_pieces():
    V, F = bowl(3)
    S, G = noisy_soup(np.concatenate([V, V + np.array([5, 0, 0])]), np.concatenate([F, F + len(V)]))
    result = flatten(S, G, weld=1e-6, weights=np.ones(len(G)))
    assert result.certificate.bijective
    assert len(atlas.SeamedMesh(S, G, uv=result.uv).weld(1e-6).islands) == 2


def test_flatten_welds_fixed_vertices_and_the_start():
    V, F = bowl()
    S, G = noisy_soup(V, F)
    joint = find_representatives(S, G, 1e-6)
    one, other = np.flatnonzero(joint == joint[G[5, 1]])[:2]
    far = int(np.abs(S - S[one]).sum(axis=1).argmax())
    target = np.array([[0.0, 0], [1, 1], [0, 0]])
    start = flatten(S, G, weld=1e-6).uv
    result = flatten(S, G, weld=1e-6, fixed=[one, far, other], target=target, start=start)
    assert result.certificate.bijective
    assert np.array_equal(result.uv[[one, far, other]], target)
    assert not flatten(S, G, weld=1e-6, fixed=[one, far], target=target[:2], record_every=1).path
    with pytest.raises(ValueError, match=rf"fixed vertex {other} welded to a fixed vertex with another"):
        flatten(S, G, weld=1e-6, fixed=[one, far, other], target=np.array([[0.0, 0], [1, 1], [0, 0.1]]))


def test_flatten_still_rejects_vertices_without_triangle():
    S, G = noisy_soup(*bowl(2))
    with pytest.raises(ValueError, match=r"not in any triangle|without triangle|no triangle"):
        flatten(np.concatenate([S, [[5, 5, 5]]]), G, weld=1e-6)


def test_seams_stay_seams_if_a_map_is_welded():
    V, F = bowl()
    S, G = noisy_soup(V, F)
    uv = flatten(S, G, weld=1e-6).uv
    left = S[G].mean(axis=1)[:, 0] < 0
    uv[G[left]] -= [7, 0]
    mesh = atlas.SeamedMesh(S, G, uv=uv)
    assert len(atlas.certify(mesh).islands) == len(F)
    for weld in (1e-6, 1e-2):
        verdict = atlas.certify(mesh, weld=weld)
        assert verdict.bijective
        assert sorted(np.flatnonzero(left).tolist()) in [one.triangles.tolist() for one in verdict.islands]
        assert len(verdict.islands) == 2
    with pytest.raises(ValueError, match="weld must be"):
        atlas.certify(mesh, weld=-1)


def test_cuts_of_a_mesh_without_map_are_not_welded():
    S, G = noisy_soup(*bowl())
    mesh = atlas.SeamedMesh(S, G)
    assert len(mesh.weld(1e-6).islands) == 1
    cut = mesh.weld(1e-6).cut(mesh.weld(1e-6).F[:, :2])
    assert cut.weld(1e-6) is cut
    with pytest.raises(ValueError, match="weld it first"):
        atlas.SeamedMesh(S, G, G[::-1]).weld(1e-6)
    for function in (atlas.flatten, atlas.polish):
        with pytest.raises(ValueError, match="weld the mesh first"):
            function(mesh, weld=1e-6)


def write_soup(path):
    S, G = noisy_soup(*bowl())
    io.write_obj(path, MeshData(S, G))
    return S, G


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_commands_weld(tmp_path, capsys, suffix):
    S, _ = write_soup(tmp_path / "soup.obj")
    V, _ = bowl()
    out, report = str(tmp_path / f"flat{suffix}"), str(tmp_path / "a.json")
    assert main(["flatten", str(tmp_path / "soup.obj"), "--weld", "1e-6", "-o", out, "--json", report]) == 0
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))["welded_vertices"] == len(S) - len(V)
    assert f"{len(S) - len(V)} vertices welded" in capsys.readouterr().out
    assert main(["check", out, "--weld", "1e-6"]) == 0
    text = capsys.readouterr().out
    assert "1 component (0 closed)" in text
    assert "Bijective" in text
    assert main(["check", out, "--weld", "no"]) == main(["check", out]) == 0
    assert "Bijective" not in capsys.readouterr().out
    out = str(tmp_path / f"unwrapped{suffix}")
    assert main(["unwrap", str(tmp_path / "soup.obj"), "--weld", "1e-6", "-o", out, "--resolution", "256"]) == 0
    text = capsys.readouterr().out
    assert "vertices merged" in text
    assert f"cleaned: {len(V)} vertices" in text
    if suffix == ".obj":
        # Welded corners share rows of texture coordinates.
        assert len(io.read_mesh(out).vt) < 2 * len(V)


def test_flatten_command_welds_vertices_of_its_files(tmp_path):
    S, G = write_soup(tmp_path / "soup.obj")
    joint = find_representatives(S, G, 1e-6)
    source, flat, again = (str(tmp_path / name) for name in ("soup.obj", "flat.obj", "again.obj"))
    assert main(["flatten", source, "--weld", "1e-6", "-o", flat]) == 0
    # The last of several welded vertices stands for all.
    last = [int(np.flatnonzero(joint == joint[v])[-1]) for v in (G[0, 0], G[9, 1])]
    (tmp_path / "fixed.txt").write_text("\n".join(map(str, last)), encoding="utf-8")
    assert main(["flatten", flat, "--weld", "1e-6", "--fixed", str(tmp_path / "fixed.txt"), "-o", again]) == 0
    before, after = io.read_mesh(flat), io.read_mesh(again)
    for v in last:
        corner = np.nonzero(np.isin(before.F, v))
        assert np.array_equal(after.corner_uv[corner], before.corner_uv[corner])
    assert joint[last[0]] != last[0]
    # Both ends of an edge, by vertices that are welded to others.
    inner = np.abs(S).max(axis=1) < 0.5
    edge = next(
        (int(np.flatnonzero(joint == joint[a])[-1]), int(np.flatnonzero(joint == joint[b])[-1]))
        for a, b in G[:, :2].tolist()
        if inner[a] and inner[b]
    )
    (tmp_path / "edges.txt").write_text(f"{edge[0]} {edge[1]}\n", encoding="utf-8")
    assert main(["flatten", source, "--weld", "1e-6", "--seams", str(tmp_path / "edges.txt"), "-o", again]) == 0


def test_command_names_a_wrong_distance_and_collapsed_triangles(tmp_path, capsys):
    write_soup(tmp_path / "soup.obj")
    source, out = str(tmp_path / "soup.obj"), str(tmp_path / "out.obj")
    for command in (["unwrap", source, "-o", out], ["flatten", source, "-o", out], ["check", source]):
        for value in ("-1", "nan", "inf", "maybe"):
            with pytest.raises(SystemExit):
                main([*command, "--weld", value])
            assert f"--weld: {value} is neither yes, no, nor a finite distance" in capsys.readouterr().err
        assert main([*command, "--weld", "0.9"]) == (1 if command[0] == "check" else 2)
        assert "smaller distance" in "".join(capsys.readouterr())
    assert not (tmp_path / "out.obj").exists()
    (tmp_path / "fixed.txt").write_text("0\n", encoding="utf-8")
    for further, words in ((["--fixed", str(tmp_path / "fixed.txt")], "omit --weld"), (["--boundary"], "and --weld")):
        assert main(["check", source, "--weld", "0", *further]) == 2
        assert words in capsys.readouterr().err


def test_check_of_a_planar_mesh_welds_equal_positions(tmp_path, capsys):
    io.write_obj(tmp_path / "a.obj", MeshData(*soup(*disk(3))))
    assert main(["check", str(tmp_path / "a.obj"), "--weld", "yes"]) == 0
    assert "Bijective" in capsys.readouterr().out


def test_the_import_stays_light():
    code = "import sys, quasiharmonic.geometry.mesh.splitting; print('scipy.spatial' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"
