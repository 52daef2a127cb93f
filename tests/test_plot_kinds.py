"""Figures of displacement fields, of texture coordinates, and of the convergence of several results."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import MapResult, boundary_loops, injective_map, unwrap
from quasiharmonic.plot import plot_convergence, plot_field, plot_unwrap
from quasiharmonic.surfaces import disk, starfish
from shared.commands import run


def bump(*shape, height):
    """A field along x with a bump in the middle, which folds if it is high."""
    grids = np.meshgrid(*(np.arange(size) - size // 2 for size in shape), indexing="ij")
    field = np.zeros((*shape, len(shape)))
    field[..., 0] = height * np.exp(-sum(grid**2 for grid in grids) / 8)
    return field


def texts(figure):
    return [text.get_text() for text in figure.texts]


def count_red(ax):
    """Number of polygons in the colour of inverted triangles, in all collections of a panel."""
    colors = np.concatenate([collection.get_facecolors() for collection in ax.collections])
    return int(np.isclose(colors[:, :3], (0.89, 0.07, 0.17)).all(axis=1).sum())


@pytest.mark.parametrize(("height", "folds"), [(9.0, True), (0.5, False)])
def test_folded_cells_of_a_field_are_red(height, folds):
    figure = plot_field(bump(12, 14, height=height), spacing=(2.0, 1.0))
    assert (count_red(figure.axes[0]) > 0) is folds
    assert count_red(figure.axes[0]) == count_red(figure.axes[1])
    assert texts(figure)[0] == f"field: {count_red(figure.axes[0])} cells folded"


def test_a_field_of_voxels_shows_the_slice_with_most_folds():
    field = np.zeros((6, 8, 8, 3))
    field[3:] = bump(3, 8, 8, height=4.0)
    figure = plot_field(field)
    slice_ = int(texts(figure)[0].split("slice ")[1].split(":")[0])
    assert slice_ in (3, 4)
    assert count_red(figure.axes[0]) > 0


def test_a_field_in_which_all_cells_fold_is_drawn():
    field = np.zeros((3, 3, 2))
    field[..., 0] = [2, 0, -2]
    assert count_red(plot_field(field).axes[1]) == 4


def test_cells_have_the_colour_of_their_area_ratio():
    field = np.zeros((4, 5, 2))
    field[..., 0] = 0.5 * np.arange(5)
    colors = plot_field(field).axes[0].collections[0].get_facecolors()
    np.testing.assert_array_equal(colors, np.tile(colors[0], (12, 1)))
    # Enlarged cells are blue to violet, not orange.
    assert colors[0, 2] > colors[0, 0]


def test_the_command_draws_fields(tmp_path, capsys):
    np.save(tmp_path / "a.npy", bump(8, 8, height=4.0))
    assert run("plot", tmp_path / "a.npy", "-o", tmp_path / "a.png") == 0
    assert (tmp_path / "a.png").stat().st_size > 5000
    assert run("plot", tmp_path / "a.npy", "-o", tmp_path / "b.png", "--kind", "map") == 2
    assert "is a displacement field: omit --kind" in capsys.readouterr().err
    assert not (tmp_path / "b.png").exists()


@pytest.fixture(scope="module")
def unwrapped():
    return unwrap(*starfish(3, 6))


@pytest.mark.slow
def test_an_unwrapped_model_is_drawn(unwrapped):
    figure = unwrapped.plot()
    charts = unwrapped.n_charts
    assert texts(figure) == [
        f"{charts} charts: no triangle inverted",
        "checkerboard",
        "stretch",
        "texel density, relative to the mean",
    ]
    layout, board, *measured = figure.axes[:4]
    colors = layout.collections[0].get_facecolors()
    assert len(np.unique(colors, axis=0)) == charts
    assert board.images
    assert all(count_red(ax) == 0 for ax in (layout, *measured))
    assert "<img" in unwrapped._repr_html_()


@pytest.mark.slow
def test_a_mirrored_chart_is_not_inverted_and_a_reversed_triangle_is():
    V, F = disk(4)
    assert texts(plot_unwrap(V, F, V * [-1, 1]))[0] == "1 chart: no triangle inverted"
    uv = V.copy()
    uv[0] = [0.4, 0.1]
    figure = plot_unwrap(V, F, uv)
    assert texts(figure)[0] == "1 chart: 2 inverted"
    assert count_red(figure.axes[0]) == 2


@pytest.fixture(scope="module")
def results():
    V, F = disk(4)
    (rim,) = boundary_loops(F)
    bean = V[rim] * (1 + 0.5 * V[rim, :1])
    return {name: injective_map(V, F, rim, bean, strategy=name, polish="mips") for name in ("speed", "paper")}


@pytest.mark.parametrize(("pack", "names"), [(dict, ["speed", "paper"]), (lambda r: list(r.values()), ["0", "1"])])
def test_several_results_have_a_colour_and_a_name_each(results, pack, names):
    energy, inverted = plot_convergence(pack(results)).axes
    assert [text.get_text() for text in energy.get_legend().get_texts()] == names
    assert len({line.get_color() for line in energy.lines}) == 2
    assert len(inverted.lines) == len(energy.lines) == 4
    assert energy.get_xlim()[1] == max(result.n_iterations for result in results.values())


def test_wrong_results_are_rejected(results):
    with pytest.raises(ValueError, match="there are no results to draw"):
        plot_convergence([])
    with pytest.raises(ValueError, match="result must be a MapResult, not 'b'"):
        plot_convergence({"a": "b"})
    empty = MapResult(results["speed"].uv, results["speed"].status, results["speed"].certificate)
    with pytest.raises(ValueError, match="no history"):
        plot_convergence([results["speed"], empty])
