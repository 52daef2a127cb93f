"""Unwrap some triangles of a model, while all others keep their texture coordinates."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import io, unwrap
from quasiharmonic.atlas import pack_charts
from quasiharmonic.results import UnwrapStatus
from quasiharmonic.surfaces import disk, starfish
from shared.closed_surfaces import torus
from shared.commands import run
from shared.examples import examples

V, F = starfish(3, 6)
FIRST = unwrap(V, F, resolution=256, texels_per_unit=16)
UV = FIRST.uvs[FIRST.indices]
SOME = V[F].mean(axis=1)[:, 0] > 1


def corners(result):
    return result.uvs[result.indices]


def same_bits(one, other):
    return np.array_equal(np.ascontiguousarray(one).view(np.int64), np.ascontiguousarray(other).view(np.int64))


@pytest.mark.parametrize("form", ["mask", "numbers"])
def test_other_triangles_keep_their_coordinates_bit_for_bit(form):
    faces = SOME if form == "mask" else np.flatnonzero(SOME)[::-1]
    result = unwrap(V, F, resolution=256, uv=UV, faces=faces)
    assert same_bits(corners(result)[~SOME], UV[~SOME])
    assert not np.array_equal(corners(result)[SOME], UV[SOME])
    assert (V[result.vmapping][result.indices] == V[F]).all()
    assert result.success
    assert result.status is UnwrapStatus.UNWRAPPED
    assert result.certificate.bijective
    assert result.certificate.clearance >= 4
    np.testing.assert_array_equal(np.unique(result.kept_charts[result.charts[~SOME]]), [True])
    np.testing.assert_array_equal(np.unique(result.kept_charts[result.charts[SOME]]), [False])
    assert np.isnan(result.triangle_stretch[~SOME]).all()
    assert "kept" in result.summary()


def test_the_border_of_the_selection_becomes_seams():
    result = unwrap(V, F, resolution=256, uv=UV, faces=SOME)
    inside, outside = (
        {tuple(sorted(side)) for row in rows.tolist() for side in zip(row, row[1:] + row[:1], strict=True)}
        for rows in (F[SOME], F[~SOME])
    )
    assert inside & outside <= {tuple(edge) for edge in result.seams.tolist()}


def test_new_charts_have_the_mean_density_of_the_others():
    result = unwrap(V, F, resolution=256, uv=UV, faces=SOME)
    assert result.texels_per_unit == pytest.approx(16, rel=0.05)
    finer = unwrap(V, F, resolution=256, uv=UV, faces=SOME, texels_per_unit=17)
    assert finer.texels_per_unit == pytest.approx(17)
    assert same_bits(corners(finer)[~SOME], UV[~SOME])


def test_charts_that_do_not_fit_are_an_error_with_a_sufficient_density():
    with pytest.raises(ValueError, match=r"free part of 256 × 256 texels: texels_per_unit=[\d.]+ suffices") as caught:
        unwrap(V, F, resolution=256, uv=UV, faces=SOME, texels_per_unit=90)
    density = float(str(caught.value).split("texels_per_unit=")[1].split()[0])
    assert unwrap(V, F, resolution=256, uv=UV, faces=SOME, texels_per_unit=density).success


def test_many_charts_that_do_not_fit_are_an_error_within_seconds():
    faces = np.random.default_rng(0).random(len(F)) < 0.5
    began = time.process_time()
    with pytest.raises(ValueError, match="charts with a padding of 4 texels do not fit into the free part"):
        unwrap(V, F, resolution=64, uv=UV, faces=faces)
    assert time.process_time() - began < 20


def test_no_free_space_is_an_error():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    points, triangles = np.concatenate([square, square + np.array([2, 0])]), np.concatenate([quad, quad + 4])
    options = {"resolution": 64, "uv": np.concatenate([square, square]), "faces": [2, 3]}
    with pytest.raises(ValueError, match="use more tiles or less padding"):
        unwrap(points, triangles, **options)
    # A second tile has space.
    result = unwrap(points, triangles, tiles=2, texels_per_unit=20, **options)
    assert result.success
    assert corners(result)[2:, :, 0].min() > 1


def test_faults_of_kept_charts_are_reported():
    tangled = UV.copy()
    wrong = np.flatnonzero(~SOME)[5]
    tangled[wrong] = tangled[wrong, ::-1]
    result = unwrap(V, F, resolution=256, uv=tangled, faces=SOME)
    assert result.status is UnwrapStatus.KEPT_FAULTS
    assert result.success
    assert not result.certificate.bijective
    assert same_bits(corners(result)[~SOME], tangled[~SOME])
    overlapping = UV.copy()
    rest = np.flatnonzero(~SOME)
    charts = FIRST.charts[rest]
    assert len(np.unique(charts)) > 1
    moved = rest[charts == charts[0]]
    other = rest[charts == charts[charts != charts[0]][0]]
    overlapping[moved] += UV[other].mean(axis=(0, 1)) - UV[moved].mean(axis=(0, 1))
    result = unwrap(V, F, resolution=256, uv=overlapping, faces=SOME)
    assert len(result.certificate.overlapping)
    assert result.success


def test_mirrored_and_far_kept_charts_are_accepted():
    result = unwrap(V, F, resolution=256, uv=UV * [-1, 1] + [40, -0.0], faces=SOME)
    assert result.status is UnwrapStatus.UNWRAPPED
    assert corners(result)[SOME].max() <= 1


def test_degenerate_triangles_that_are_not_selected_keep_their_coordinates():
    triangles = np.concatenate([F, [[0, 0, 1]], F[:1]])
    uv = np.concatenate([UV, [[[0.5, 0.25], [0.75, -0.0], [0.0, 3.0]]], UV[:1] + 2])
    faces = np.append(SOME, [False, False])
    result = unwrap(V, triangles, resolution=256, uv=uv, faces=faces)
    assert same_bits(corners(result)[~faces], uv[~faces])
    repeated = np.append(SOME, [False, True])
    assert unwrap(V, triangles, resolution=256, uv=uv, faces=repeated).success


def test_coordinates_of_vertices():
    points, triangles = disk(4)
    uv = points / 8 + 0.3
    chosen = np.arange(6)
    result = unwrap(points, triangles, resolution=256, uv=uv, faces=chosen)
    assert same_bits(corners(result)[6:], uv[triangles[6:]])
    assert result.success


@pytest.mark.slow
def test_all_triangles_may_be_selected():
    result = unwrap(V, F, resolution=256, uv=UV, faces=np.ones(len(F), dtype=bool))
    np.testing.assert_array_equal(result.uvs, unwrap(V, F, resolution=256).uvs)


@pytest.mark.slow
def test_demanded_seams_and_labels_of_selected_triangles():
    plain = unwrap(V, F, resolution=256, uv=UV, faces=SOME)
    inner = F[SOME][5, :2]
    result = unwrap(V, F, resolution=256, uv=UV, faces=SOME, seams=[inner], labels=np.zeros(len(F), dtype=int))
    assert sorted(inner.tolist()) in result.seams.tolist()
    border = plain.seams[np.isin(plain.seams, F[SOME]).all(axis=1) & np.isin(plain.seams, F[~SOME]).all(axis=1)]
    with pytest.raises(ValueError, match="of no_seams became seams"):
        unwrap(V, F, resolution=256, uv=UV, faces=SOME, no_seams=border)


@pytest.mark.long
@given(st.integers(0, 2**31), st.floats(0.01, 0.4))
@examples(12)
def test_any_triangles_can_be_selected(seed, share):
    V, F = torus(16, 8, 1.5)
    first = unwrap(V, F, resolution=256, texels_per_unit=6)
    uv = first.uvs[first.indices]
    faces = np.random.default_rng(seed).random(len(F)) < share
    faces[0] = True
    result = unwrap(V, F, resolution=256, uv=uv, faces=faces, padding=2)
    assert result.certificate.bijective
    assert result.certificate.clearance >= 2
    assert same_bits(corners(result)[~faces], uv[~faces])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"faces": [0]}, "faces needs uv"),
        ({"faces": [], "uv": UV}, "faces selects no triangle"),
        ({"faces": np.zeros(len(F), dtype=bool), "uv": UV}, "faces selects no triangle"),
        ({"faces": [True, False], "uv": UV}, "faces must be a mask of shape"),
        ({"faces": [[0, 1]], "uv": UV}, r"faces must have shape \(k,\), numbers of triangles, not \(1, 2\)"),
        ({"faces": [0, len(F)], "uv": UV}, f"faces refers to triangle {len(F)}"),
        ({"faces": [-1], "uv": UV}, "faces refers to triangle -1"),
        ({"faces": [0.5], "uv": UV}, "faces must contain integer"),
        (
            {"faces": [0], "uv": np.where(np.arange(len(F))[:, None, None] == 7, np.nan, UV)},
            "no texture .* triangle 7,",
        ),
    ],
)
def test_wrong_selections_are_named(options, words):
    with pytest.raises(ValueError, match=words):
        unwrap(V, F, resolution=256, **options)


def test_charts_are_packed_around_others():
    uv, triangles = disk(6)
    first = pack_charts([(uv, triangles)] * 4, resolution=256, padding=4)
    occupied = np.concatenate(first.uv[:2]), np.concatenate([triangles, triangles + len(uv)])
    for density in (None, 20):
        packed = pack_charts(
            [(uv, triangles)] * 3, resolution=256, padding=4, texels_per_unit=density, occupied=occupied
        )
        together = [*first.uv[:2], *packed.uv]
        apart = [
            np.linalg.norm(256 * (one[:, None] - other[None]), axis=2).min()
            for k, one in enumerate(together)
            for other in together[:k]
        ]
        assert min(apart) >= 4
        assert 256 * min(one.min() for one in packed.uv) >= 2


def test_stacked_kept_charts_with_extremely_thin_triangles_are_bijective():
    points, rows = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0.5, 0.5, 0]]), np.array([[0, 1, 3], [1, 2, 3]])
    copies = np.concatenate([points, points + np.array([3, 0, 0]), points + np.array([6, 0, 0])])
    thin = np.array([[0, 0], [0.25, 0], [0.25, 0.25], [0.125, 1e-18]])
    triangles = np.concatenate([rows, rows + 4, rows + 8])
    result = unwrap(copies, triangles, uv=np.tile(thin, (3, 1)), faces=[4, 5], stack=True, resolution=64)
    assert result.certificate.bijective
    assert result.status is UnwrapStatus.UNWRAPPED


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_faces_of_a_file(tmp_path, suffix):
    model, out, report = tmp_path / f"model{suffix}", tmp_path / f"out{suffix}", tmp_path / "report.json"
    io.write_mapped(model, io.MeshData(V, F, vt=FIRST.uvs, FT=FIRST.indices))
    np.savetxt(tmp_path / "faces.txt", np.flatnonzero(SOME), fmt="%d")
    options = ["--faces", tmp_path / "faces.txt", "--resolution", 256, "--json", report]
    assert run("unwrap", model, "-o", out, *options) == 0
    before, after = io.read_mesh(model), io.read_mesh(out)
    assert same_bits(after.corner_uv[~SOME], before.corner_uv[~SOME])
    assert not np.array_equal(after.corner_uv[SOME], before.corner_uv[SOME])
    assert json.loads(report.read_text())["kept_charts"] > 0


def test_wrong_files_of_faces(tmp_path, capsys):
    (tmp_path / "model.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    (tmp_path / "faces.txt").write_text("1\n")
    call = ["unwrap", tmp_path / "model.obj", "-o", tmp_path / "out.obj", "--faces", tmp_path / "faces.txt"]
    assert run(*call) == 2
    assert "no texture coordinates (vt) to keep" in capsys.readouterr().err
    (tmp_path / "model.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1 4/1\n")
    assert run(*call) == 2
    assert "faces.txt refers to face 1, but there are only faces 0 … 0" in capsys.readouterr().err
