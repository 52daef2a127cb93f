"""Arguments of a wrong type raise errors that name the parameter."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import (
    InverseMap,
    MovingMesh,
    SurfaceMap,
    atlas,
    batch,
    boundary_loops,
    flatten,
    injective_map,
    injective_maps,
    io,
    morph,
    plot,
    surfaces,
    targets,
    warp_along,
)
from quasiharmonic.surfaces import disk

V, F = disk(2)
(LOOP,) = boundary_loops(F)
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
IMAGE = np.zeros((4, 4))

CALLS = {
    "inner of ring": (lambda value: targets.ring(value), "inner"),
    "radius of disk": (lambda value: targets.disk(value), "radius"),
    "tolerance of outline": (lambda value: targets.outline("disk", tolerance=value), "tolerance"),
    "tolerance of letter": (lambda value: targets.letter("R", tolerance=value), "tolerance"),
    "overlap of word": (lambda value: targets.word("QH", overlap=value), "overlap"),
    "corner_angle of arc_length": (
        lambda value: targets.arc_length(SQUARE, SQUARE, corner_angle=value),
        "corner_angle",
    ),
    "corner_angle of boundary_to": (
        lambda value: targets.boundary_to(V, F, "disk", corner_angle=value),
        "corner_angle",
    ),
    "tolerance of flattened_edges": (
        lambda value: targets.flattened_edges(F, np.arange(len(V)), V, tolerance=value),
        "tolerance",
    ),
    "contour of signed_area": (targets.signed_area, "contour"),
    "rings of cat": (surfaces.cat, "rings"),
    "V of refine": (lambda value: surfaces.refine(value, F), "V"),
    "squares": (lambda value: plot.plot_texture(V, F, V, squares=value), "squares"),
    "vertices of plot_problem": (lambda value: plot.plot_problem(V, F, [0], V[:1], vertices=value), "vertices"),
    "inverted of plot_map": (lambda value: plot.plot_map(V, F, V, inverted=[value]), "inverted"),
    "start of atlas.flatten": (lambda value: atlas.flatten(io.MeshData(V, F), start=value), "start"),
    "shape of warp_along": (lambda value: warp_along(IMAGE, V, F, V, shape=(value, value)), "shape"),
    "corner_angle of Settings": (lambda value: batch.Settings(corner_angle=value), "corner_angle"),
    "max_iterations of Settings": (lambda value: batch.Settings(max_iterations=value), "max_iterations"),
    "refine of Settings": (lambda value: batch.Settings(refine=value), "refine"),
    "points of locate": (lambda value: InverseMap(V, F, V).locate(value), "points"),
}


@pytest.mark.parametrize("value", [None, "text", float("nan")])
@pytest.mark.parametrize(("call", "name"), CALLS.values(), ids=CALLS)
def test_a_value_that_is_no_number(call, name, value):
    with pytest.raises(ValueError, match=rf"\b{name}\b"):
        call(value)


@pytest.mark.parametrize("value", [None, 1.5, object(), [1]])
@pytest.mark.parametrize(
    ("call", "name"),
    [
        (io.read_mesh, "path"),
        (io.read_obj, "path"),
        (io.read_texture, "path"),
        (io.read_problem, "source"),
        (lambda value: io.write_map(value, io.MeshData(V, F), V), "path"),
        (lambda value: plot.save_map_figure(value, V, F, V), "path"),
        (lambda value: list(batch.read_table(value)), "path"),
        (lambda value: list(batch.find_problems(value)), "source"),
        (targets.outline, "specification"),
        (targets.read_svg, "path"),
        (targets.read_polylines, "path"),
    ],
)
def test_a_value_that_is_no_file_name(call, name, value):
    with pytest.raises(ValueError, match=f"^{name} must be the name of a file, not "):
        call(value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: targets.filled(None), "contours must be a sequence of contours"),
        (lambda: targets.letter(3), "character must be a single character, not 3"),
        (lambda: plot.plot_convergence(V), "result must be a MapResult, not a ndarray"),
        (lambda: SurfaceMap(None, None), "source must be an InverseMap, not None"),
        (lambda: InverseMap(V * np.nan, F, V), "V is not finite at vertices 0, 1"),
        (lambda: io.write_per_triangle("a.csv", V, F, V, [1]), "values must be a Mapping, not a list"),
        (lambda: batch.Settings(strategy="bogus"), "strategy must be one of speed, paper, not 'bogus'"),
        (lambda: batch.Settings(linear_solver=1), "linear_solver must be one of auto, .*, not 1"),
        (lambda: batch.Settings(to=1), "to must be a text or None, not 1"),
        (lambda: batch.Settings(corner_angle=30), "corner_angle applies only to plain meshes with an outline"),
        (lambda: batch.run("a", "b", {}), "settings must be a Settings, not a dict"),
        (lambda: injective_maps(None), "problems must be a sequence of problems, not None"),
        (lambda: boundary_loops([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), r"edge \(0, 1\) in more than two triangles"),
        (lambda: morph(V, F, [1, 1], V[[1, 1]]), "moved_vertices contains vertex 1 more than once"),
        (lambda: MovingMesh(V, F, [1, 1]), "moved_vertices contains vertex 1 more than once"),
        (lambda: injective_map(V, F, LOOP, V[LOOP], polish="foo"), "polish must be one of .*, not 'foo'"),
        (lambda: injective_map(V, F, LOOP, V[LOOP], slide=True), "give an energy as well, by polish"),
        (lambda: flatten(V, F, linear_solver=[]), "linear_solver must be one of auto, .*, not a list"),
    ],
)
def test_other_wrong_values(call, message):
    with pytest.raises(ValueError, match=message):
        call()
