"""Boundaries onto outlines with holes, and surfaces that are cut open."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from quasiharmonic import Problem, cut_open, injective_map, refine, surfaces, targets
from quasiharmonic.geometry.mesh.topology import boundary_loops, edges
from quasiharmonic.targets import boundary_to, flattened_edges, outline
from quasiharmonic.targets.boundary.boundary_to import choose_least_stretch
from quasiharmonic.targets.boundary.correspondence import arc_parameters, find_parameters, points_at
from shared.boundaries import holed, placed, torus


def octahedron():
    V = np.concatenate([np.eye(3), -np.eye(3)])
    F = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    V, F = surfaces.refine(V, F)
    return V / np.linalg.norm(V, axis=1)[:, None], F


# --- several loops


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "holes"),
    [
        ("ring:0.4", [(0.4, 0, 0.25)]),
        ("letter:R", [(0.1, 0.3, 0.2)]),
        ("letter:A", [(0, -0.4, 0.2)]),
        ("letter:B", [(0, 0.5, 0.15), (0.1, -0.4, 0.2)]),
        ("letter:8", [(-0.5, 0, 0.15), (0.5, 0, 0.15)]),
    ],
)
def test_holes_go_to_the_holes_of_the_outline(text, holes):
    V, F = holed(250, *holes)
    contours = outline(text)
    fixed, target = boundary_to(V, F, contours)
    assert len(fixed) == len(np.unique(edges(F, len(V)).boundary))
    split = flattened_edges(F, fixed, target)
    refined = refine(V, F, split)
    result = injective_map(refined.V, refined.F, fixed, target)
    assert result.injective
    assert result.certificate.bijective


@pytest.mark.slow
def test_holes_go_to_the_closest_contour():
    centres = np.array([(-0.5, -0.4), (0.5, -0.4), (0.0, 0.55)])
    V, F = holed(600, *((x, y, 0.12) for x, y in centres))
    square = targets.rectangle(0.2, 0.2) - 0.1
    contours = [targets.disk(), *(square + 0.9 * c for c in np.roll(centres, 1, axis=0))]
    where = placed(V, F, contours)
    for loop in boundary_loops(F, len(V)):
        middle = V[loop, :2].mean(axis=0)
        if len(loop) < 60:
            near = np.argmin(np.linalg.norm(centres - middle, axis=1))
            assert where[loop].mean(axis=0) == pytest.approx(0.9 * centres[near], abs=0.05)


@pytest.mark.slow
def test_holes_are_rotated_for_the_least_energy():
    """Compare with the Dirichlet energy of Tutte's embedding, over all combinations of a few rotations."""
    from quasiharmonic import quasi_harmonic_map

    V, F = holed(150, (-0.45, 0.1, 0.2), (0.4, 0.2, 0.2), seed=1)
    fixed = np.concatenate(boundary_loops(F, len(V)))
    problem = Problem(V, F, fixed, V[fixed, :2])
    outer = int(np.argmax([len(loop) for loop in problem.domain.loops]))
    inner = [i for i in range(3) if i != outer]
    square = targets.rectangle(0.4, 0.4)[::-1] - 0.2
    given = {outer: targets.arc_length(V[problem.domain.loops[outer]], targets.disk())}
    choices = {}
    for i, x in zip(inner, (0.5, -0.4), strict=True):
        s = arc_parameters(V[problem.domain.loops[i]])
        starts = range(0, len(s), max(1, len(s) // 8))
        choices[i] = [
            points_at(square + np.array([x, 0.1]), find_parameters(s, square, [(k, 0.0)], corner_angle=20))
            for k in starts
        ]

    def energy(places):
        uv = quasi_harmonic_map(problem.with_target(np.concatenate([places[i] for i in range(3)])))
        sides = uv[F] - uv[np.roll(F, -1, axis=1)]
        return float((sides**2).sum())

    every = {
        ks: energy(given | {i: choices[i][k] for i, k in zip(inner, ks, strict=True)})
        for ks in itertools.product(*(range(len(choices[i])) for i in inner))
    }
    chosen = energy(given | choose_least_stretch(problem.domain, given, choices))
    low, high = min(every.values()), max(every.values())
    assert chosen <= low + 0.01 * (high - low)


def test_a_point_assigns_loops_to_contours():
    """Turned inside out: the vertex of the hole is assigned to the outer circle."""
    V, F = surfaces.annulus(8)
    outer, inner = (int(loop[0]) for loop in boundary_loops(F, len(V)))
    circles = targets.ring(0.5)
    assert np.linalg.norm(placed(V, F, circles)[outer]) == pytest.approx(1)
    where = placed(V, F, circles, corners={inner: (1, 0)})
    assert where[inner].tolist() == [1, 0]
    assert np.linalg.norm(where[outer]) == pytest.approx(0.5, rel=1e-3)
    with pytest.raises(ValueError, match="two boundary loops have vertices that go to the same contour"):
        boundary_to(V, F, circles, corners={inner: (1, 0), outer: (0, 1)})
    with pytest.raises(ValueError, match="goes to a different contour than other vertices of its boundary loop"):
        boundary_to(V, F, circles, corners={inner: (1, 0), inner + 1: (0.5, 0)})
    with pytest.raises(ValueError, match="must lie on one boundary loop, but 2 loops have some"):
        boundary_to(V, F, circles, corners=[inner, outer])


# --- mismatches


@pytest.mark.parametrize(
    ("mesh", "text", "message"),
    [
        (
            surfaces.disk(4),
            "letter:B",
            "1 boundary loop, and the outline 3 contours .2 holes.: fill the outline's holes",
        ),
        (
            surfaces.annulus(4),
            "letter:B",
            r"2 boundary loops, and the outline 3 contours \(2 holes\): choose .* 1 hole",
        ),
        (
            surfaces.annulus(4),
            "disk",
            "2 boundary loops, and the outline 1 contour .no hole.: choose .* 1 hole, or close",
        ),
        (
            surfaces.disk(4),
            "letter:i",
            r"the outline is in 2 separate pieces \(beginning at \(.*\), \(.*\)\), and a connected surface can fill",
        ),
        (
            torus(),
            "disk",
            r"the surface is closed: .* cut it open first \(cut_open; --cut of qhm map and qhm flatten\)",
        ),
        (octahedron(), "disk", "the surface is closed"),
        ((torus()[0], torus()[1][1:]), "disk", "the surface has a handle and fits into no outline: cut it open"),
        (surfaces.disk(1), "letter:H", "the loop has 6 vertices, too few to keep the 12 corners"),
    ],
)
def test_surfaces_and_outlines_that_do_not_match(mesh, text, message):
    with pytest.raises(ValueError, match=message):
        boundary_to(*mesh, outline(text))


def test_malformed_meshes_are_left_to_the_problem():
    V, F = surfaces.disk(3)
    with pytest.raises(ValueError, match=r"more than two triangles|repeated"):
        boundary_to(V, np.vstack([F, F[3]]), outline("disk"))
    with pytest.raises(ValueError, match="2 components"):
        boundary_to(np.vstack([V, V]), np.vstack([F, F + len(V)]), outline("disk"))
    with pytest.raises(ValueError, match="refers to vertex 99"):
        boundary_to(V, np.vstack([F, [0, 1, 99]]), outline("disk"))


# --- cut open


@pytest.mark.parametrize("mesh", [torus(), (torus()[0], torus()[1][1:]), octahedron(), surfaces.annulus(6)])
def test_cut_open(mesh):
    V, F = mesh
    opened = cut_open(V, F)
    assert len(boundary_loops(opened.F, len(opened.V))) == 1
    assert np.array_equal(opened.origin[: len(V)], np.arange(len(V)))
    assert np.array_equal(opened.origin[opened.F], F)
    assert np.array_equal(opened.V, V[opened.origin])
    assert injective_map(opened.V, opened.F, *boundary_to(opened.V, opened.F, outline("disk"))).injective


@pytest.mark.parametrize("scale", [0, 1e-310, 1e-200, 1e200, 1e300])
def test_cut_open_at_any_scale(scale):
    V, F = octahedron()
    opened = cut_open(scale * V, F)
    assert len(boundary_loops(opened.F, len(opened.V))) == 1
    assert np.array_equal(opened.V, scale * V[opened.origin])


def test_cut_open_tetrahedron():
    """No two of its vertices are further apart than one edge, and cutting one edge opens nothing."""
    V, F = np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    opened = cut_open(V, F)
    assert len(boundary_loops(opened.F, len(opened.V))[0]) == 4


@pytest.mark.slow
def test_cut_open_along_more_edges_than_needed():
    V, F = surfaces.starfish(3, 12)
    copies = [len(cut_open(V, F, min_gain=gain).V) for gain in (np.inf, 0.1)]
    assert len(V) < copies[0] < copies[1]
    V, F = surfaces.disk(3)
    assert np.array_equal(cut_open(V, F).F, F)
    # An interior slit is connected to the boundary.
    slit = cut_open(V, F, edges=[[0, 1], [0, 2]])
    assert {0, 2} <= set(slit.origin[len(V) :])
    assert len(boundary_loops(slit.F, len(slit.V))) == 1


def test_surfaces_that_cannot_be_cut_open():
    V, F = surfaces.disk(3)
    with pytest.raises(ValueError, match="refers to vertex 99"):
        cut_open(V, np.vstack([F, [0, 1, 99]]))
    V, F = octahedron()
    with pytest.raises(ValueError, match=r"repeated|more than two"):
        cut_open(V, np.vstack([F, F[:1]]))
