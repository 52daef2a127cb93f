"""Lightmaps: charts on whole texels that no filter mixes. And a tile of its own for each material."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import hard_models as models
from quasiharmonic import io, unwrap
from quasiharmonic.apps.unwrapping.model_files import material_densities
from quasiharmonic.surfaces import starfish
from quasiharmonic.ui.cli import main

ROOM = models.box(4, 3, 2.5)
# A box, a tube and a triangle much smaller than a texel.
CRUMB = np.array([[0, 0, 0], [1e-4, 0, 0], [0, 1e-4, 0]]), np.array([[0, 1, 2]])


def texels_of(result, size, chart):
    """Return the texels (size, size) that have an inner point of a chart, by closely spaced points of its triangles."""
    k = max(4 * size // 8, 64)
    a, b = (one.ravel() for one in np.meshgrid(np.arange(k), np.arange(k)))
    inside = a + b < k
    weights = np.stack([a[inside], b[inside], k - 1 - (a + b)[inside]], axis=1) / (k - 1)
    weights = weights * (1 - 3e-6) + 1e-6
    points = np.einsum("pc,fcd->fpd", weights, result.uvs[result.indices[result.charts == chart]]).reshape(-1, 2)
    at = np.floor(points * size).astype(int)
    covered = np.zeros((size + 2, size + 2), dtype=bool)
    covered[at[:, 0] + 1, at[:, 1] + 1] = True
    return covered


def widened(covered):
    """Return texels and their eight neighbours, which a bilinear filter reads."""
    return np.any([np.roll(covered, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0)


def find_leaks(result, size):
    # A texel between charts that both filters read has the values of one of them.
    charts = [widened(texels_of(result, size, chart)) for chart in range(result.n_charts)]
    return [(i, j) for i, j in combinations(range(len(charts)), 2) if (charts[i] & charts[j]).any()]


@pytest.mark.parametrize(
    ("mesh", "options"),
    [
        (ROOM, {"resolution": 64}),
        (ROOM, {"resolution": 64, "padding": 4}),
        (ROOM, {"resolution": (64, 32), "padding": 4, "rotate": False}),
        (models.tube(12), {"resolution": 64, "padding": 4}),
        pytest.param(starfish(2, 12), {"resolution": 64, "padding": 4}, marks=pytest.mark.slow),
    ],
)
def test_no_filter_mixes_charts(mesh, options):
    result = unwrap(*mesh, lightmap=True, **options)
    assert result.certificate.bijective
    assert result.certificate.clearance >= options.get("padding", 4)
    assert result.resolution[0] == 64
    if result.resolution == (64, 64):
        assert not find_leaks(result, 64)
        assert not find_leaks(result, 32)


@pytest.mark.slow
def test_the_leak_test_finds_leaks():
    # The same room without a lightmap, and a lightmap at a resolution for which it is not made.
    assert find_leaks(unwrap(*ROOM, resolution=64, padding=0.1, hard_edges=60), 64)
    assert find_leaks(unwrap(*ROOM, lightmap=True, resolution=64, padding=4), 16)


def test_walls_of_a_room_are_rectangles_between_texels():
    result = unwrap(*ROOM, lightmap=True, resolution=64)
    assert result.n_charts == 6
    texels = result.uvs * 64
    np.testing.assert_array_equal(texels, np.rint(texels))
    lengths = {4.0: set(), 3.0: set(), 2.5: set()}
    for triangle, places in zip(ROOM[0][ROOM[1]], texels[result.indices], strict=True):
        for side in range(3):
            long = np.linalg.norm(triangle[side] - triangle[side - 1])
            if long in lengths:
                lengths[long].add(float(np.abs(places[side] - places[side - 1]).max()))
    for long, (texels_long,) in lengths.items():
        assert abs(texels_long - long * result.texels_per_unit) <= 0.5
    # Charts begin at even texels, so that they keep whole texels of half the resolution.
    for chart in range(6):
        rows = result.indices[result.charts == chart]
        assert (texels[rows].min(axis=(0, 1)) % 2 == 0).all()
    assert 1 < result.stretch.worst < 1.1


def test_edges_above_60_degrees_are_seams():
    tube = models.tube(12)
    assert unwrap(*tube, lightmap=True, resolution=128).n_charts == 1
    assert unwrap(*tube, lightmap=True, resolution=128, hard_edges=20).n_charts == 12


def test_charts_are_at_least_two_texels_wide():
    result = unwrap([ROOM, CRUMB], lightmap=True, resolution=64)
    small = result.parts[1]
    np.testing.assert_allclose(np.ptp(small.uvs * 64, axis=0), 2, atol=1e-5)
    assert result.certificate.bijective
    strip = np.array([[0, 0, 0], [4, 0, 0], [4, 0.01, 0], [0, 0.01, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    part = unwrap([ROOM, strip], lightmap=True, resolution=64).parts[1]
    assert np.ptp(part.uvs * 64, axis=0).min() == 2


def test_charts_that_whole_texels_stretch_beyond_the_bound_are_reported():
    result = unwrap(*ROOM, lightmap=True, resolution=64, texels_per_unit=1, max_stretch=1.2)
    assert result.status.name == "STRETCHED"
    assert result.stretch.p99 > 1.2
    assert max(miss.excess for miss in result.misses) == pytest.approx(result.stretch.p99 - 1.2)
    assert "use a higher resolution" in result.message
    finer = unwrap(*ROOM, lightmap=True, resolution=64, max_stretch=1.2)
    assert (finer.status.name, finer.misses) == ("UNWRAPPED", ())


def test_instances_have_places_of_their_own():
    result = unwrap([ROOM, ROOM], lightmap=True, resolution=128)
    assert not {*result.parts[0].charts} & {*result.parts[1].charts}


def test_a_texel_density_is_kept():
    result = unwrap(*ROOM, lightmap=True, resolution=128, texels_per_unit=6)
    assert result.texels_per_unit == 6
    widths = {tuple(sorted(np.ptp(result.uvs[r] * 128, axis=0))) for r in _charts(result)}
    assert widths == {(15.0, 18.0), (15.0, 24.0), (18.0, 24.0)}


def _charts(result):
    return [np.unique(result.indices[result.charts == k]) for k in range(result.n_charts)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lightmap": True, "stack": True}, "each chart has its own place: omit stack"),
        ({"lightmap": True, "tiles": 2}, "omit tiles, tile_by and faces"),
        ({"lightmap": True, "padding": 1}, "a padding of at least 4 texels, not 1"),
        ({"lightmap": True, "resolution": 8}, "6 charts .* do not fit into a lightmap of 8 × 8 texels: use 32 × 32"),
        ({"lightmap": True, "texels_per_unit": 90, "resolution": 64}, "do not fit into a lightmap of 64 × 64 texels"),
        ({"lightmap": True, "texels_per_unit": 1e8, "resolution": 64}, "64 texels: reduce the padding or the texel"),
        ({"lightmap": 1}, "lightmap must be True or False"),
        ({"tile_by": "material"}, "needs materials: pass a file"),
        ({"tile_by": [0, 1]}, "tile_by must have shape \\(12,\\), one for each triangle"),
        ({"tile_by": [0] * 12, "tiles": 2}, "omit tiles, faces and stack"),
    ],
)
def test_wrong_options(options, message):
    with pytest.raises((ValueError, TypeError), match=message):
        unwrap(*ROOM, **options)


def test_a_sufficient_size_is_named():
    unwrap(*ROOM, lightmap=True, resolution=32)


@pytest.mark.slow
def test_triangles_with_one_number_have_a_tile_of_their_own():
    V, F = starfish(3, 12)
    centre = V[F].mean(axis=1)
    number = np.where(centre[:, 0] > 0, 7, 3) + 10 * (centre[:, 1] > 0)
    result = unwrap(V, F, tile_by=number, resolution=256)
    assert result.certificate.bijective
    assert result.certificate.clearance >= 4
    places = np.floor(result.uvs[result.indices])
    expected = np.searchsorted(np.unique(number), number)
    np.testing.assert_array_equal(places[:, :, 0], np.repeat(expected[:, None], 3, axis=1))
    assert not places[:, :, 1].any()
    # All tiles have one density.
    z = result.uvs[result.indices] @ [256, 256j]
    texels = ((z[:, 1] - z[:, 0]).conj() * (z[:, 2] - z[:, 0])).imag / 2
    P = V[F]
    area = np.linalg.norm(np.cross(P[:, 1] - P[:, 0], P[:, 2] - P[:, 0]), axis=1) / 2
    for k in np.unique(number):
        own = number == k
        assert texels[own].sum() / area[own].sum() == pytest.approx(result.texels_per_unit**2, rel=0.05)


@pytest.mark.slow
def test_tiles_at_a_density_or_none():
    V, F = ROOM
    number = np.arange(12) // 6
    result = unwrap(V, F, tile_by=number, texels_per_unit=20, resolution=256)
    assert result.texels_per_unit == 20
    np.testing.assert_array_equal(np.floor(result.uvs[result.indices][:, 0, 0]), number)
    with pytest.raises(ValueError, match="do not fit into 256 × 256"):
        unwrap(V, F, tile_by=number, texels_per_unit=200, resolution=256)


def write_materials(path):
    """Write a room whose floor and ceiling, the first four triangles, have a material of their own."""
    lines = b"usemtl floor\nusemtl wall\n"
    io.write_mapped(path, io.MeshData(*ROOM, statements=lines, statement_faces=np.array([0, 4])))
    return path


@pytest.mark.slow
def test_materials_of_files_and_of_trimesh_have_tiles(tmp_path):
    source, out = write_materials(tmp_path / "in.obj"), tmp_path / "out.obj"
    assert main(["unwrap", str(source), "--tile-by", "material", "-o", str(out)]) == 0
    tile = np.floor(io.read_mesh(out).corner_uv[:, 0, 0])
    np.testing.assert_array_equal(tile, np.repeat([0, 1], [4, 8]))
    result = unwrap(source, tile_by="material")
    np.testing.assert_array_equal(np.floor(result.uvs[result.indices][:, 0, 0]), tile)
    with pytest.raises(ValueError, match="with a padding of 4 texels do not fit"):
        unwrap(source, tile_by="material", texels_per_unit=1e4)
    trimesh = pytest.importorskip("trimesh")
    meshes = [trimesh.Trimesh(*ROOM, process=False) for _ in range(3)]
    for mesh, name in zip(meshes, ["a", "b", "a"], strict=True):
        mesh.visual = trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(name=name))
    parts = unwrap(meshes, tile_by="material").parts
    assert [float(np.floor(part.uvs[0, 0])) for part in parts] == [0, 1, 0]


@pytest.mark.slow
def test_lightmaps_of_files(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(*ROOM, process=False), node_name="one", geom_name="room")
    scene.graph.update(frame_to="two", geometry="room", matrix=np.diag([2.0, 2, 2, 1]))
    (tmp_path / "in.glb").write_bytes(scene.export(file_type="glb"))
    report = tmp_path / "report.json"
    arguments = ["unwrap", str(tmp_path / "in.glb"), "--lightmap", "--resolution", "128", "--json", str(report)]
    assert main([*arguments, "-o", str(tmp_path / "out.glb")]) == 0
    written = io.read_mesh(tmp_path / "out.glb")
    assert len(written.F) == 24
    assert len({*written.carried.number_meshes()}) == 2
    assert json.loads(report.read_text())["charts"] == 12
    for options in ({"lightmap": True}, {"instances": "own"}):
        result = unwrap(tmp_path / "in.glb", resolution=128, **options)
        assert len(result.indices) == 24
    assert len(unwrap(tmp_path / "in.glb", resolution=128).indices) == 12


@pytest.mark.parametrize(("shared", "densities"), [("share", [1, 1]), ("own", [1, 0.5])])
def test_the_density_of_each_material_is_reported(tmp_path, capsys, shared, densities):
    source, report = write_materials(tmp_path / "in.obj"), tmp_path / "report.json"
    V, F = ROOM
    mesh = io.read_mesh(source)
    if shared == "own":
        # The walls have a quarter of the texels for their area.
        mesh = replace(mesh, V=np.concatenate([V, V + 9]), F=np.concatenate([F[:4], F[4:] + 8]))
    result = unwrap(mesh.V, mesh.F, weld=False) if shared == "share" else None
    if result is None:
        scaled = mesh.V.copy()
        scaled[8:] /= 2
        result = replace(unwrap(scaled, mesh.F, weld=False), V=mesh.V)
    found = material_densities(mesh, result)
    expected = [result.texels_per_unit * factor for factor in densities]
    np.testing.assert_allclose([found["floor"], found["wall"]], expected, rtol=1e-3)
    assert main(["unwrap", str(source), "-o", str(tmp_path / "out.obj"), "--json", str(report)]) == 0
    facts = json.loads(report.read_text())
    assert facts["material_texels_per_unit"] == pytest.approx(
        dict.fromkeys(["floor", "wall"], facts["texels_per_unit"])
    )
    assert "texels per unit by material: floor" in capsys.readouterr().out
