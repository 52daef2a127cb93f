"""Hard-surface models: whole flat faces, unrolled pieces, straight charts; each promise by a count of its own."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import hard_models as models
from quasiharmonic import unwrap
from shared.boundaries import torus
from shared.examples import examples
from shared.hinges import (
    count_flat_faces,
    cut_flat_edges,
    edges_of,
    euler_characteristic,
    groups,
    straight_share,
    stretches,
)

RECTILINEAR = {
    "channel": models.channel(),
    "long channel": models.channel(length=12, thick=0.1),
    "bracket": models.bracket(),
    "stairs": models.stairs(),
    "box": models.box(),
    "fine box": models.box(1, 2, 3, times=3),
    "tower": models.blocks(np.array([[[1, 1, 1], [1, 0, 0]], [[1, 1, 0], [0, 0, 0]]], dtype=bool)),
}
DEVELOPABLE = RECTILINEAR | {
    "house": models.house(),
    "bracket with a fillet": models.bracket(fillet=6),
    "plate": models.plate(),
    "gear": models.gear(),
    "open tube": models.tube(),
    "tube with caps": models.tube(rings=3, caps=True),
    "tube of twelve sides": models.tube(12, rings=2, caps=True),
    "hexagonal prism": models.tube(6, rings=4, caps=True),
    "cone": models.cone(),
    "open cone": models.cone(cap=False),
    "robot": models.robot(),
    "untwisted band": models.twisted_band(half_turns=0),
}


def is_isometric(V, F, result, tolerance=1e-4):
    """Whether all lengths are scaled by one factor; rounding to single precision moves short sides."""
    low, high = stretches(np.asarray(V, dtype=float), F, result)
    return high.max() <= (1 + tolerance) * low.min()


@pytest.fixture(scope="module")
def layouts():
    found = {}

    def layout(name):
        if name not in found:
            found[name] = unwrap(*DEVELOPABLE[name], resolution=1024)
        return found[name]

    return layout


@pytest.mark.slow
@pytest.mark.parametrize("name", DEVELOPABLE)
def test_flat_faces_are_whole_and_nothing_is_stretched(name, layouts):
    (V, F), result = DEVELOPABLE[name], layouts(name)
    assert result.success
    assert not result.misses
    assert cut_flat_edges(V, F, result.indices).tolist() == []
    assert is_isometric(V, F, result)
    assert result.stretch.worst <= 1 + 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", DEVELOPABLE)
def test_pieces_are_joined(name, layouts):
    """No model has more charts than flat faces; most have fewer, and the texture is used."""
    result, faces = layouts(name), count_flat_faces(*DEVELOPABLE[name])
    # The plates of these fill the texture best if they are single.
    single = name in ("channel", "fine box", "hexagonal prism")
    assert result.n_charts <= faces if single else result.n_charts < max(faces, 2)
    assert result.utilisation >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", RECTILINEAR)
def test_right_angles_lie_along_the_axes(name, layouts):
    result = layouts(name)
    assert straight_share(result.indices, result.uvs) >= 0.999


@pytest.mark.slow
@pytest.mark.parametrize("name", ["channel", "stairs", "plate", "tube with caps", "robot"])
def test_rotated_models_have_the_same_charts(name, layouts):
    V, F = DEVELOPABLE[name]
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    result = unwrap(V @ turn.T, F, resolution=1024, symmetry=None)
    upright = unwrap(V, F, resolution=1024, symmetry=None)
    assert result.n_charts == upright.n_charts
    assert result.seam_length == pytest.approx(upright.seam_length)
    assert result.utilisation == pytest.approx(upright.utilisation, abs=0.05)
    assert cut_flat_edges(V, F, result.indices).tolist() == []
    if name in RECTILINEAR:
        assert straight_share(result.indices, result.uvs) >= 0.999


@pytest.mark.slow
@pytest.mark.parametrize("n", [12, 24])
@pytest.mark.parametrize("rings", [1, 4])
def test_a_tube_has_one_straight_cut(n, rings):
    V, F = models.tube(n, 0.5, 2, rings)
    result = unwrap(V, F, resolution=512)
    edges = edges_of(V, F, result.indices)
    cut = V[edges.ends[edges.seam]]
    assert result.n_charts == 1
    assert edges.length[edges.seam].sum() == pytest.approx(2)
    # A ruling has one position in x and y.
    assert np.ptp(cut[..., :2], axis=(0, 1)) == pytest.approx(0, abs=1e-12)
    assert is_isometric(V, F, result)
    assert straight_share(result.indices, result.uvs) >= 0.999


@pytest.mark.parametrize("n", [7, 8, 16, 60])
def test_a_cone_has_one_straight_cut(n):
    V, F = models.cone(n, height=1, cap=False)
    result = unwrap(V, F, resolution=512)
    edges = edges_of(V, F, result.indices)
    assert (result.n_charts, np.count_nonzero(edges.seam)) == (1, 1)
    assert is_isometric(V, F, result)


@pytest.mark.long
@pytest.mark.parametrize(("across", "deep", "corners"), [(3, 1, 16), (2, 3, 12), (8, 5, 4)])
def test_plates_keep_their_holes(across, deep, corners):
    V, F = models.plate(across, deep, thick=0.05, corners=corners)
    result = unwrap(V, F, resolution=4096, padding=1)
    for z in (0, 0.05):
        chart = result.charts[(V[F][:, :, 2] == z).all(axis=1)]
        assert len(set(chart.tolist())) == 1
        rows = result.indices[(V[F][:, :, 2] == z).all(axis=1)]
        assert euler_characteristic(rows) == 1 - across * deep
    assert cut_flat_edges(V, F, result.indices).tolist() == []


@pytest.mark.slow
def test_a_sheet_with_five_hundred_holes_is_one_chart():
    V, F = models.pierced(25, 20, corners=8)
    result = unwrap(V, F, resolution=2048)
    assert (result.n_charts, len(result.seams), result.success) == (1, 0, True)
    assert euler_characteristic(result.indices) == 1 - 500
    assert is_isometric(V, F, result)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "degrees"), [("house", 30), ("house", 60), ("gear", 30), ("stairs", 89), ("plate", 20)]
)
def test_hard_edges_are_seams(name, degrees):
    V, F = DEVELOPABLE[name]
    result = unwrap(V, F, resolution=1024, hard_edges=degrees)
    edges = edges_of(V, F, result.indices)
    hard = edges.degrees > degrees
    assert hard.any()
    assert edges.seam[hard].all()
    assert cut_flat_edges(V, F, result.indices).tolist() == []
    # Other seams are needed only to open tubes: each removes a handle or a loop of its part.
    parts = len(np.unique(groups(len(F), edges.left[~hard], edges.right[~hard])))
    assert parts <= result.n_charts <= parts + np.count_nonzero(edges.seam & ~hard)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stairs", "bracket", "channel", "box"])
def test_edges_that_are_exactly_as_sharp_are_not_hard(name):
    """Rounding does not decide about right angles."""
    V, F = DEVELOPABLE[name]
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    V = V @ turn.T * np.sign(np.linalg.det(turn))
    without, result = (unwrap(V, F, resolution=512, hard_edges=degrees) for degrees in (None, 90))
    np.testing.assert_array_equal(result.seams, without.seams)


@pytest.mark.long
@pytest.mark.parametrize("name", ["channel", "stairs", "gear", "plate", "house"])
def test_a_larger_loss_gives_fewer_charts(name):
    V, F = DEVELOPABLE[name]
    found = [unwrap(V, F, resolution=1024, packing_loss=loss) for loss in (0, 0.02, 0.1, 1)]
    counts = [result.n_charts for result in found]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < count_flat_faces(V, F)
    assert found[0].utilisation >= found[-1].utilisation - 0.02


@pytest.mark.slow
def test_pieces_are_divided_for_packing_on_request():
    V, F = models.tube(24, 0.1, 6, 24)
    whole = unwrap(V, F, resolution=512)
    divided = unwrap(V, F, resolution=512, divide_for_packing=True)
    assert whole.n_charts < divided.n_charts
    assert divided.utilisation > whole.utilisation + 0.1
    assert is_isometric(V, F, divided)


@pytest.mark.slow
def test_a_belt_longer_than_the_texture_is_divided_into_whole_quadrilaterals():
    x, turn = np.linspace(0, 60, 61), 0.3 * np.arange(61)
    points = np.stack([np.stack([x, y + 0 * x, np.sin(turn)], axis=1) for y in (0, 1)], axis=1)
    V, F = models.sheet(points)
    result = unwrap(V, F, resolution=512)
    assert 1 < result.n_charts < 30
    np.testing.assert_array_equal(result.charts[:60], result.charts[60:])
    assert is_isometric(V, F, result)
    assert straight_share(result.indices, result.uvs) >= 0.999


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_rough_spheres_have_few_charts(seed):
    V, F = models.golf_ball(np.random.default_rng(seed))
    edges = edges_of(V, F, F)
    assert np.count_nonzero(edges.degrees > 30) > len(edges.ends) / 5
    result = unwrap(V, F, resolution=512)
    assert result.n_charts <= 20
    assert result.stretch.p99 <= 1.5


@pytest.mark.long
@pytest.mark.parametrize(("cells", "faces"), [(20, 375), pytest.param(40, 1500, marks=pytest.mark.nightly)])
def test_many_flat_faces_take_seconds(cells, faces):
    V, F = models.terrain(cells, np.random.default_rng(2))
    began = time.process_time()
    result = unwrap(V, F, resolution=2048, padding=1)
    assert time.process_time() - began < 60
    assert result.success
    assert count_flat_faces(V, F) > faces
    assert result.n_charts < count_flat_faces(V, F)
    assert cut_flat_edges(V, F, result.indices).tolist() == []


@pytest.mark.slow
def test_coplanar_faces_that_touch_in_a_vertex():
    V = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 0, 0], [-1, -1, 0], [0, -1, 0]]
    F = [[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 6]]
    result = unwrap(V, F, resolution=256)
    assert result.success
    assert result.n_charts == 2
    assert cut_flat_edges(np.array(V), np.array(F), result.indices).tolist() == []


def layer(cells):
    """The flat surface of some cells of a grid."""
    m, n = cells.shape
    plane = np.stack(np.meshgrid(np.arange(m + 1.0), np.arange(n + 1.0), indexing="ij"), axis=-1)
    V, F = models.sheet(np.pad(plane, [(0, 0), (0, 0), (0, 1)]))
    used, number = np.unique(F[np.tile(cells.ravel(), 2)], return_inverse=True)
    return V[used], number.reshape(-1, 3)


@pytest.mark.slow
@given(st.integers(0, 2**31))
@examples(30)
def test_flat_faces_that_touch_themselves_in_vertices_are_whole(seed):
    cells = np.random.default_rng(seed).random((6, 6)) < 0.65
    cells[0, :2] = cells[1, 0] = True
    V, F = layer(cells)
    result = unwrap(V, F, resolution=512)
    assert result.success
    assert cut_flat_edges(V, F, result.indices).tolist() == []
    assert is_isometric(V, F, result, 1e-3)


def test_a_ring_whose_ends_touch_is_one_chart():
    cells = np.ones((3, 3), dtype=bool)
    cells[1, 1] = cells[2, 2] = False
    V, F = layer(cells)
    result = unwrap(V, F, resolution=256)
    assert (result.n_charts, result.success) == (1, True)


@pytest.mark.parametrize("around", [12, 24, 48])
def test_rings_of_a_torus_with_twelve_sides_stay_together(around):
    result = unwrap(*torus(around, 12))
    assert result.success
    assert result.n_charts <= 4


@pytest.mark.parametrize("sides", [6, 8, 10])
def test_tori_with_few_sides_have_few_charts_that_fill_the_texture(sides):
    mesh = torus(4 * sides, sides)
    result = unwrap(*mesh)
    assert result.success
    assert result.n_charts <= 4
    assert result.utilisation > 0.55
    # Rings that must be charts, or with little stretch, are unrolled without stretch.
    for options in ({"hard_edges": 30}, {"max_stretch": 1.1}):
        assert unwrap(*mesh, **options).stretch.worst < 1.01


def test_tubes_with_chamfers_are_no_tori():
    angle = 2 * np.pi * np.arange(32) / 32
    profile = np.array(
        [[1.3, 0.2], [1.2, 0.3], [0.8, 0.3], [0.7, 0.2], [0.7, -0.2], [0.8, -0.3], [1.2, -0.3], [1.3, -0.2]]
    )
    V = np.concatenate([np.stack([r * np.cos(angle), r * np.sin(angle), 0 * angle + z], axis=1) for r, z in profile])
    i, j = (index.ravel() for index in np.indices((8, 32)))
    a, b = 32 * i + j, 32 * i + (j + 1) % 32
    c, d = (b + 32) % 256, (a + 32) % 256
    F = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    assert unwrap(V, F).stretch.worst < 1.01


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 11, 40])
def test_moebius_bands_are_cut_open(n):
    V, F = models.twisted_band(n)
    result = unwrap(V, F, resolution=256, packing_loss=0.1)
    assert result.success
    assert result.n_charts <= n + 1
    assert np.count_nonzero(edges_of(V, F, result.indices).seam) <= n + 1


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-9, 1e-7, 3e-7])
def test_faces_that_are_flat_within_the_tolerance_stay_whole(noise):
    """The tolerance is 2e-6 of the diagonal."""
    V, F = models.box(1, 2, 3, times=3)
    exact = edges_of(V, F, F).degrees < 1
    size = np.linalg.norm(np.ptp(V, axis=0))
    moved = V + noise * size * np.random.default_rng(3).uniform(-1, 1, V.shape)
    result, without = (unwrap(points, F, resolution=1024, symmetry=None) for points in (moved, V))
    assert not (edges_of(V, F, result.indices).seam & exact).any()
    # Edges of equal length are joined in another order.
    assert result.n_charts <= without.n_charts


@pytest.mark.slow
@pytest.mark.parametrize("noise", [1e-6, 1e-5, 1e-4, 1e-3])
def test_almost_flat_faces_have_little_stretch(noise):
    V, F = models.box(1, 2, 3, times=3)
    size = np.linalg.norm(np.ptp(V, axis=0))
    moved = V + noise * size * np.random.default_rng(3).uniform(-1, 1, V.shape)
    result = unwrap(moved, F, resolution=1024)
    assert result.success
    assert result.n_charts <= 16
    assert result.stretch.p99 <= 1.5


@pytest.mark.slow
@pytest.mark.parametrize("exponent", [-150, -80, -30, 30, 80, 150])
@pytest.mark.parametrize("name", ["stairs", "tube with caps", "robot"])
def test_models_of_any_size(name, exponent, layouts):
    V, F = DEVELOPABLE[name]
    result = unwrap(V * 10.0**exponent, F, resolution=1024)
    assert result.success
    assert result.n_charts == layouts(name).n_charts
    assert result.utilisation == pytest.approx(layouts(name).utilisation, abs=0.02)
    assert result.symmetry.applied == layouts(name).symmetry.applied


@pytest.mark.slow
@pytest.mark.parametrize("name", ["channel", "plate", "robot"])
def test_equal_results_for_any_number_of_threads(name, layouts):
    for jobs in (1, 3):
        for one, other in zip(unwrap(*DEVELOPABLE[name], resolution=1024, jobs=jobs), layouts(name), strict=True):
            np.testing.assert_array_equal(one, other)


def test_integer_positions():
    V, F = models.blocks(np.ones((2, 1, 1), dtype=bool))
    whole, same = (unwrap(points, F, resolution=256) for points in (V.astype(np.int32), V))
    np.testing.assert_array_equal(whole.uvs, same.uvs)
    assert cut_flat_edges(V, F, whole.indices).tolist() == []


@pytest.mark.long
@given(st.integers(3, 14), st.integers(0, 2**31), st.sampled_from([0.05, 1, 20]), st.integers(1, 3))
@examples(25)
@example(3, 322, 20, 2)  # faces longer than the texture
def test_random_profiles(n, seed, length, rings):
    random = np.random.default_rng(seed)
    angle = np.sort(random.uniform(0, 2 * np.pi, n))
    # The smallest angle between corners keeps the triangles of the caps from being extremely thin.
    angle = 0.7 * angle + 0.3 * 2 * np.pi * np.arange(n) / n
    outline = random.uniform(0.3, 1.5, (n, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    V, F = models.profile(outline, np.linspace(0, length, rings + 1))
    result = unwrap(V, F, resolution=1024)
    assert result.success
    # Faces that are longer than the texture are divided.
    assert length > 1024 / result.texels_per_unit or cut_flat_edges(V, F, result.indices).tolist() == []
    assert is_isometric(V, F, result, 1e-3)


@pytest.mark.parametrize(
    ("gear", "most", "least"),
    [
        ({"teeth": 24, "tooth": 0.1, "thick": 0.2}, 12, 0.5),
        ({"teeth": 40, "radius": 2, "tooth": 0.12, "bore": 0.5, "thick": 0.6}, 20, 0.6),
    ],
    ids=["two disks fill a diagonal", "teeth are joined"],
)
def test_gears_have_few_charts_that_fill_the_texture(gear, most, least):
    """Two disks of equal size are as large as possible on a diagonal, where smaller ones are not placed."""
    result = unwrap(*models.gear(**gear), resolution=1024, padding=4)
    assert result.certificate.bijective
    assert result.n_charts <= most
    assert result.utilisation > least


@pytest.mark.parametrize("size", [(30, 18), (60, 30)])
def test_a_ring_of_a_smooth_surface_in_one_plane_may_be_cut(size):
    """The top and the bottom of these tori are flat rings. Kept whole, they would prevent all cuts across them."""
    assert unwrap(*torus(*size)).n_charts <= 4
