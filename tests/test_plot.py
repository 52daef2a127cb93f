"""Figures: sizes, red exactly at inverted triangles, no global state."""

from __future__ import annotations

import shutil
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.image import imread
from PIL import Image

from quasiharmonic import inverted_triangles, surfaces
from quasiharmonic import io as files
from quasiharmonic.energies.measures import MEASURES
from quasiharmonic.plot import (
    plot_before_after,
    plot_distortion,
    plot_map,
    plot_surface,
    plot_texture,
    save_animation,
    save_map_figure,
    save_texture_figure,
)
from quasiharmonic.targets.boundary.correspondence import viewer_axes
from quasiharmonic.ui.cli import main
from quasiharmonic.ui.plot import interactive
from quasiharmonic.ui.plot.canvas import RED, new_figure, view
from quasiharmonic.ui.plot.measures import LABELS


def pixels(figure):
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255


def red(image):
    """Return the pixels of the red that only inverted triangles have."""
    return (image[..., 0] > 0.8) & (image[..., 1] < 0.25) & (image[..., 2] < 0.35)


@pytest.fixture(scope="module")
def planar():
    V, F = surfaces.random_delaunay(150, seed=4)
    folded = V.copy()
    folded[149] = V[0] * 0.9  # across its neighbours
    return V, F, folded


def flips(F, uv):
    a, b = uv[F[:, 1]] - uv[F[:, 0]], uv[F[:, 2]] - uv[F[:, 0]]
    return a[:, 0] * b[:, 1] <= a[:, 1] * b[:, 0]


def test_map_is_red_only_where_it_is_inverted(planar):
    V, F, folded = planar
    assert not red(pixels(plot_map(V, F, V).figure)).any()
    image = pixels(plot_map(V, F, folded).figure)
    assert image.shape == (600, 600, 3)
    assert flips(F, folded).sum() >= 2
    assert red(image).sum() > 100


@pytest.mark.slow
def test_inverted_triangles_can_be_given(planar):
    V, F, _ = planar
    one = red(pixels(plot_map(V, F, V, inverted=[17]).figure))
    mask = np.zeros(len(F), dtype=bool)
    mask[17] = True
    assert one.any()
    assert np.array_equal(one, red(pixels(plot_map(V, F, V, inverted=mask).figure)))
    assert not red(pixels(plot_map(V, F, planar[2], inverted=[]).figure)).any()


@pytest.mark.slow
def test_triangles_too_small_to_be_visible_are_marked():
    V, F = surfaces.grid(40, 40)
    uv = V.copy()
    # Nine vertices shrunk to a hundredth of a pixel and turned inside out.
    centre = 20 + 20 * 41
    near = [centre + i + 41 * j for i in (-1, 0, 1) for j in (-1, 0, 1)]
    uv[near] = V[centre] + (V[near] - V[centre])[:, ::-1] * 1e-4
    image = red(pixels(plot_map(V, F, uv).figure))
    assert image[280:320, 280:320].sum() > 8
    assert flips(F, uv).sum() >= 8


@pytest.mark.slow
def test_interior_pins_are_drawn_and_boundary_vertices_are_not(planar):
    V, F, _ = planar
    boundary = np.arange(int(np.unique(F).size ** 0.5))[:5]
    plain = pixels(plot_map(V, F, V).figure)
    assert np.array_equal(plain, pixels(plot_map(V, F, V, fixed=boundary).figure))
    assert not np.array_equal(plain, pixels(plot_map(V, F, V, fixed=[*boundary, 149]).figure))


def test_before_after(planar):
    V, F, folded = planar
    image = red(pixels(plot_before_after(V, F, folded, V)))
    assert image.shape == (480, 900)
    assert image[:, :450].any()
    assert not image[:, 450:].any()


@pytest.mark.slow
def test_saved_figure_has_three_panels_or_two(planar, tmp_path):
    V, F, folded = planar
    save_map_figure(tmp_path / "three.png", V, F, V, folded)
    image = imread(tmp_path / "three.png")[..., :3]
    assert image.shape == (450, 1200, 3)
    columns = red(image).any(axis=0)
    assert columns[400:800].any()
    assert not columns[:400].any()
    assert not columns[800:].any()
    for panel in np.split(image, 3, axis=1):
        assert (panel < 0.9).any(axis=2).mean() > 0.3
    save_map_figure(tmp_path / "two.png", V, F, V)
    assert imread(tmp_path / "two.png").shape[:2] == (450, 800)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["three.png", "two.png"]


@pytest.mark.slow
def test_given_inverted_triangles_are_marked_on_the_map_only(planar, tmp_path):
    V, F, folded = planar
    save_map_figure(tmp_path / "map.png", V, F, V, folded, inverted=[3], fixed=[0])
    columns = red(imread(tmp_path / "map.png")).any(axis=0)
    assert columns[400:800].sum() > 20
    assert columns[800:].any()


@pytest.mark.slow
def test_the_surface_hides_what_is_behind():
    V, F = surfaces.cat(16)
    seen = view(V, F)
    assert seen.points.shape == (len(V), 2)
    # Depth grows towards the viewer, who looks at the nose, far in front of the boundary.
    assert seen.depth[0] > seen.depth[-96:].max()
    assert seen.inside.mean() < 0.25
    assert seen.color.min() >= 0
    assert seen.color.max() <= 1
    assert np.ptp(seen.color) > 0.1
    # Without relief nothing is hidden, and a planar mesh is shown in its plane.
    W, G = surfaces.annulus(6)
    flat = view(W, G)
    assert flat.points == pytest.approx(W)
    assert not flat.inside.any()


def sphere(hole):
    """Return a unit sphere without a small cap around the direction ``hole``."""
    V, F = surfaces.disk(16)
    angle = np.hypot(*V.T) * np.radians(165)
    turn = np.arctan2(V[:, 1], V[:, 0])
    top = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
    return top @ viewer_axes(-np.asarray(hole, dtype=float)), F


@pytest.mark.parametrize("hole", [(0, -1, 0), (0, 1, 0), (0, 0, -1), (1, 0, 0)])
def test_surfaces_are_shown_with_their_hole_below(hole):
    V, F = sphere(hole)
    assert view(V, F).points[-96:, 1].mean() < -0.8


def test_the_inner_side_is_grey():
    V, F = sphere((1, 1, 1))
    figure = new_figure((3, 3))
    ax = figure.add_axes((0, 0, 1, 1))
    plot_surface(V, F, ax)
    image = pixels(figure)
    seen = view(V, F)
    rim = seen.points[-96:].mean(axis=0)

    def saturation(point):
        x, y = ax.transData.transform(point)
        pixel = image[round(299 - y), round(x)]
        return float(np.ptp(pixel) / pixel.max())

    assert saturation(rim) < 0.2
    assert saturation(-rim) > 0.4


def test_not_finite_vertices_are_named(planar):
    V, F, _ = planar
    uv = V.copy()
    uv[77, 1] = np.nan
    with pytest.raises(ValueError, match="uv is not finite at vertex 77"):
        plot_map(V, F, uv)
    with pytest.raises(ValueError, match="before is not finite at vertex 77"):
        plot_before_after(V, F, uv, V)


def test_degenerate_map_is_drawn(planar):
    V, F, _ = planar
    image = pixels(plot_map(V, F, np.zeros_like(V)).figure)
    assert red(image).any()


@pytest.mark.long
def test_distortion_shows_inverted_triangles(planar):
    V, F, folded = planar
    assert red(pixels(plot_distortion(V, F, folded, "isometric"))).any()
    assert tuple(LABELS) == MEASURES


@pytest.mark.slow
def test_the_histogram_of_distortion_contains_the_whole_area(planar):
    V, F, _ = planar
    bars = plot_distortion(V, F, V * (3, 1), "conformal").axes[2]
    heights = [bar.get_height() for bar in bars.patches]
    assert sum(heights) == pytest.approx(100)
    # One value everywhere, 3, in one bar.
    assert max(heights) == pytest.approx(100)


@pytest.mark.long
@pytest.mark.parametrize("measure", LABELS)
def test_colour_bars_have_labels(planar, measure):
    """Five values at the colour bar, those of the histogram; its ends are open if values may lie beyond."""
    V, F, _ = planar
    figure = plot_distortion(V, F, np.column_stack([V[:, 0] ** 2 / 3 + V[:, 0], 1e-3 * V[:, 1]]), measure)
    image = pixels(figure)
    assert image.shape == (450, 1350, 3)
    assert not red(image).any()
    bars, bar = figure.axes[2:]
    names = [label.get_text() for label in bar.get_yticklabels()]
    assert names == [label.get_text() for label in bars.get_xticklabels()]
    assert len(names) == 5
    # A triangle at each open end.
    assert len(bar.patches) == (2 if measure in ("sigma1", "sigma2", "area_ratio") else 1)


@pytest.mark.slow
def test_distortion_of_flat_triangles_and_without_values():
    V, F = np.array([[0, 0], [1, 0], [2, 0], [0, 1.0]]), np.array([[0, 1, 2], [0, 1, 3]])
    uv = np.array([[0, 0], [1, 0], [2, 0.5], [0, 1.0]])
    figure = plot_distortion(V, F, uv, "area_ratio")
    # The flat triangle has no value; the other one is all of the area in the histogram.
    assert sum(bar.get_height() for bar in figure.axes[2].patches) == pytest.approx(100)
    with pytest.raises(ValueError, match="no finite value"):
        plot_distortion(V, F, uv * (1, -1), "mips")
    with pytest.raises(ValueError, match="measure must be one of"):
        plot_distortion(V, F, uv, "beauty")


@pytest.mark.long
def test_texture_shows_the_checkerboard_and_inverted_triangles(planar, tmp_path):
    V, F, folded = planar
    figure = plot_texture(V, F, V, squares=4)
    assert not red(pixels(figure)).any()
    board = np.asarray(figure.axes[1].images[0].get_array())
    # A round domain of diameter 2 fills 600 pixels times 0.96, with as many light as dark pixels.
    inside = board[..., 3] == 1
    assert inside.mean() == pytest.approx(np.pi / 4 / 1.04**2, abs=0.02)
    blue = inside & (board[..., 0] < 0.4)
    assert blue.sum() / inside.sum() == pytest.approx(0.5, abs=0.03)
    # Adjacent squares have different colours, across both sides.
    column = [blue[300 + round(600 / 1.04 / 4 * (k + 0.5) * s), 330] for k in (0, 1) for s in (-1, 1)]
    assert column[0] != column[1]
    assert column[0] != column[2]
    save_texture_figure(tmp_path / "folded.png", V, F, folded)
    assert red(imread(tmp_path / "folded.png")[..., :3]).any()
    with pytest.raises(ValueError, match="squares must be an integer of at least 1"):
        plot_texture(V, F, V, squares=0)


@pytest.mark.long
def test_texture_shows_the_closer_of_two_sheets():
    # Two overlapping squares; only the upper one, mapped far to the right, is visible.
    V = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
    F = np.array([[0, 1, 3], [0, 3, 2], [4, 5, 7], [4, 7, 6]])
    uv = V[:, :2] + np.where(V[:, 2:] > 0, (0.0, 0.0), (10.0, 0.0))
    both = plot_texture(V, F, uv, squares=1).axes[0].images[0].get_array()
    upper = plot_texture(V, F[[2, 3]], uv, squares=1).axes[0].images[0].get_array()
    assert both.shape == upper.shape
    middle = np.s_[250:350, 250:350, :3]
    assert np.abs(both[middle] - both[300, 300, :3]).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_animation(planar, tmp_path, suffix):
    V, F, folded = planar
    path = tmp_path / f"a.{suffix}"
    if suffix == "mp4" and shutil.which("ffmpeg") is None and find_spec("imageio_ffmpeg") is None:
        with pytest.raises(ImportError, match=r"\[video\]"):
            save_animation(path, V, F, [("one", V)])
        return
    save_animation(path, V, F, ((f"frame {k}", uv) for k, uv in enumerate([folded, V, V])), frames_per_second=10)
    if suffix == "gif":
        with Image.open(path) as image:
            assert image.size == (600, 600)
            # Pillow joins two equal frames.
            assert image.n_frames in (2, 3)
            assert image.info["loop"] == 0
            assert red(np.asarray(image.convert("RGB")) / 255).sum() > 100
            image.seek(image.n_frames - 1)
            assert not red(np.asarray(image.convert("RGB")) / 255).any()
    else:
        assert path.read_bytes()[4:8] == b"ftyp"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.slow
def test_an_animation_shows_every_frame_completely(planar, tmp_path):
    """One frame leaves the window of the first, and only a frame in the middle has inverted triangles."""
    V, F, folded = planar
    path = tmp_path / "a.gif"
    frames = [("small", V), ("folded", folded), ("large", 2 * V), ("apart", V + 0.7 * np.ptp(V))]
    save_animation(path, V, F, frames, frames_per_second=30)
    with Image.open(path) as image:
        shown, durations = [], []
        for t in range(image.n_frames):
            image.seek(t)
            shown.append(np.asarray(image.convert("RGB"), dtype=float) / 255)
            durations.append(image.info["duration"])
    assert [bool(red(picture).sum() > 50) for picture in shown] == [False, True, False, False]
    for picture in shown:
        rim = np.concatenate(
            [picture[-5:].reshape(-1, 3), picture[:, :5].reshape(-1, 3), picture[:, -5:].reshape(-1, 3)]
        )
        assert (rim == 1).all()
    # The format has a resolution of 0.01 s: the mean is 30 frames per second, not 33.
    assert durations == [30, 40, 30, 30 + 1000]


@pytest.mark.slow
def test_settings_of_matplotlib_do_not_change_the_size(planar, tmp_path):
    V, F, _ = planar
    with rc_context({"savefig.dpi": 30, "savefig.bbox": "tight"}):
        save_animation(tmp_path / "a.gif", V, F, [("one", V)])
        save_map_figure(tmp_path / "b.png", V, F, V)
    with Image.open(tmp_path / "a.gif") as moving, Image.open(tmp_path / "b.png") as still:
        assert (moving.size, still.size) == ((600, 600), (800, 450))


def test_errors_of_an_animation_are_reported(planar, tmp_path):
    V, F, _ = planar
    with pytest.raises(ValueError, match=r"must be \.gif or \.mp4"):
        save_animation(tmp_path / "a.avi", V, F, [("one", V)])
    with pytest.raises(ValueError, match="no frames"):
        save_animation(tmp_path / "a.gif", V, F, [])
    with pytest.raises(ValueError, match="frames_per_second"):
        save_animation(tmp_path / "a.gif", V, F, [("one", V)], frames_per_second=0)
    with pytest.raises(ValueError, match="of a GIF must be at most 50, not 60"):
        save_animation(tmp_path / "a.gif", V, F, [("one", V)], frames_per_second=60)
    lost = V.copy()
    lost[3] = np.nan
    with pytest.raises(ValueError, match="second is not finite at vertex 3"):
        save_animation(
            tmp_path / "a.gif", V, F, [("first", V), ("second", np.where(np.arange(len(V))[:, None] == 3, np.nan, V))]
        )
    for rows, message in ((V[:-1], r"second must have shape \(\d+, 2\)"), (V[:, :1], "second must have shape")):
        with pytest.raises(ValueError, match=message):
            save_animation(tmp_path / "a.gif", V, F, [("first", V), ("second", rows)])
    with pytest.raises(ValueError, match=f"fixed refers to vertex {len(V)}, but"):
        save_animation(tmp_path / "a.gif", V, F, [("one", V)], fixed=[0, len(V)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("plot", [plot_map, plot_texture, plot_distortion])
def test_maps_and_triangles_that_do_not_match_are_rejected(planar, plot):
    V, F, _ = planar
    with pytest.raises(ValueError, match=r"uv must have shape"):
        plot(V, F, V[:-1])
    with pytest.raises(ValueError, match=r"F refers to vertices .* but there are only vertices 0 …"):
        plot(V, F + len(V), V)


@pytest.mark.long
@pytest.mark.parametrize("plot", [plot_map, pytest.param(plot_texture, marks=pytest.mark.nightly)])
def test_pictures_do_not_depend_on_scale(planar, plot):
    V, F, folded = planar
    drawn = [plot(unit * V, F, unit * folded) for unit in (1, 1e-200, 1e200)]
    plain, tiny, huge = (pixels(shown.figure if plot is plot_map else shown) for shown in drawn)
    assert np.abs(plain - tiny).mean() < 0.005
    assert np.abs(plain - huge).mean() < 0.005


def test_pictures_without_matplotlib(planar, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    V, F, _ = planar
    with pytest.raises(ImportError, match="pip install 'matplotlib"):
        plot_map(V, F, V)


def test_a_window_shows_surface_and_map(planar, tmp_path, monkeypatch):
    polyscope = pytest.importorskip("polyscope")
    V, F, folded = planar
    monkeypatch.chdir(tmp_path)
    polyscope.set_verbosity(0)
    polyscope.set_use_prefs_file(False)
    polyscope.init("openGL_mock")
    interactive.add(V, F, folded)
    assert polyscope.has_surface_mesh("surface")
    # Inverted triangles are separate red meshes; the picture contains everything.
    parts = [polyscope.get_surface_mesh(name).n_faces() for name in ("map", "map: inverted")]
    assert sum(parts) == len(F)
    assert parts[1] == len(inverted_triangles(F, folded)) > 0
    assert polyscope.get_surface_mesh("surface: inverted").get_color() == pytest.approx(RED)
    camera, target = interactive.view_of(np.array([[0, 0, 0], [20, 2, 0]]), 2.0, np.pi / 2)
    assert target.tolist() == [10, 1, 0]
    assert 5 < camera[2] < 5.5
    assert polyscope.get_view_camera_parameters().get_position()[2] > 1.3
    polyscope.remove_all_structures()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("V", "F", "uv", "message"),
    [
        (
            np.zeros((3, 2)),
            np.zeros((1, 4), dtype=int),
            np.zeros((3, 2)),
            r"F must have shape \(f, 3\), triangles only, not",
        ),
        (np.zeros((3, 4)), [[0, 1, 2]], np.zeros((3, 2)), r"V must have shape \(n, 2\) or \(n, 3\), not \(3, 4\)"),
    ],
)
def test_arrays_of_another_shape(V, F, uv, message):
    with pytest.raises(ValueError, match=message):
        plot_map(V, F, uv)


def test_view_without_polyscope(planar, tmp_path, monkeypatch, capsys):
    V, F, _ = planar
    monkeypatch.setitem(sys.modules, "polyscope", None)
    mesh = tmp_path / "map.obj"
    files.write_obj(mesh, files.MeshData(V, F).with_map(V[:, :2]))
    for more in ([], ["--screenshot", str(tmp_path / "view.png")]):
        assert main(["view", str(mesh), *more]) == 2
        assert "[view]'" in capsys.readouterr().err
    assert main(["view", str(mesh), "--screenshot", str(tmp_path / "view.xyz")]) == 2
    assert "view.xyz" in capsys.readouterr().err


def test_window_without_polyscope(planar, monkeypatch):
    monkeypatch.setitem(sys.modules, "polyscope", None)
    with pytest.raises(ImportError, match=r"pip install '.*\[view\]'"):
        interactive.show(*planar)
