from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import certify, inverted_triangles, is_injective
from quasiharmonic.geometry.exact.certificate import Obstacle
from shared.exact import exact_orientation
from shared.sheets import CORNERS, SQUARE, fan, kinds, ring, spiral, square, strip, together

# --- triangles ---


def test_the_three_verdicts_on_a_triangle():
    F = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 3], [0, 0, 1], [0, 1, 4], [5, 1, 2]])
    uv = np.array([[0.0, 0], [1, 0], [0, 1], [2, 0], [np.nan, 0], [0, np.inf]])
    c = certify(F, uv)
    np.testing.assert_array_equal(c.inverted, [1])
    np.testing.assert_array_equal(c.degenerate, [2, 3])
    np.testing.assert_array_equal(c.nonfinite, [4, 5])
    np.testing.assert_array_equal(inverted_triangles(F, uv), [1, 2, 3, 4, 5])
    assert all(array.dtype == np.int64 for array in (c.inverted, c.degenerate, c.nonfinite))
    assert not c.injective
    assert c.bijective is False
    assert not is_injective(F, uv)
    said = "of 6 triangles, 1 is inverted (1), 2 are degenerate (2, 3), 2 are not finite (4, 5)"
    assert said in c.summary()


@pytest.mark.parametrize(
    ("triangle", "kind", "further", "loops", "said", "crossings"),
    [
        ((0, 1, 2), None, None, [], "Injective: the only triangle is positive. Bijective: ", []),
        (
            (0, 3, 1),
            "degenerate",
            "self-intersection",
            [0],
            "boundary loop 0 meets itself (0→3 with 1→0, 3→1 with 1→0)",
            [[0, 3, 1, 0], [3, 1, 1, 0]],
        ),
        ((0, 2, 1), "inverted", "winding", [0], "boundary loop 0 runs clockwise and no other loop is around it", []),
        ((0, 1, 4), "not finite", None, [], "Not injective: of 1 triangles, 1 is not finite (0).", []),
    ],
)
def test_every_field_of_the_certificate_of_one_triangle(triangle, kind, further, loops, said, crossings):
    F, uv = np.array([triangle]), np.array([[0.0, 0], [2, 0], [0, 1], [1, 0], [np.nan, 1]])
    c = certify(F, uv)
    positive = kind is None
    assert is_injective(F, uv) == positive
    assert inverted_triangles(F, uv).tolist() == [0] * (not positive)
    wrong = f"of 1 triangles, 1 is {kind} (0)"
    reasons = [] if positive else [{"kind": "not injective", "text": wrong, "loops": []}]
    if further:
        reasons.append({"kind": further, "text": said, "loops": loops})
        said = f"Not injective: {wrong}. Not bijective either: {said}."
    if positive:
        said += "the boundary does not meet itself, and no point is covered twice."
    assert c.to_dict() == {
        "valid": positive,
        "injective": positive,
        "bijective": positive,
        "triangles": 1,
        "inverted": [0] * (kind == "inverted"),
        "degenerate": [0] * (kind == "degenerate"),
        "nonfinite": [0] * (kind == "not finite"),
        "reasons": reasons,
        "loops": [{"start": triangle[0], "length": 3}],
        "crossings": crossings,
        "multiply_wound": [],
        "summary": said,
    }
    verdict = "injective and bijective, 1 triangle" if positive else "not injective, 1 of 1 triangle not positive"
    assert c.short_repr() == verdict
    assert certify(F, uv, boundary=False).short_repr() == verdict.replace(" and bijective", "")


def test_three_reasons_are_listed_and_the_others_counted():
    for count, rest in ((2, ""), (3, ""), (4, "; and 1 more"), (6, "; and 3 more")):
        F, uv = together(*(square(3 * k, 0, 1) for k in range(count)))
        c = certify(F, uv * [-1, 1])
        assert [r.loops for r in c.reasons[1:]] == [(k,) for k in range(count)]
        texts = [f"boundary loop {k} runs clockwise and no other loop is around it" for k in range(min(count, 3))]
        assert c.summary().endswith(f"). Not bijective either: {'; '.join(texts)}{rest}.")
    c = certify(*together(*(square(k / 2, 0, 1) for k in range(2))))
    assert c.summary().startswith("Injective: all 4 triangles are positive. Not bijective: boundary loops 0 and 1 meet")
    assert c.short_repr() == "injective, not bijective, 4 triangles"
    # Two squares with a common corner have four pairs of edges that meet there.
    c = certify(*together(square(0, 0, 1), square(1, 1, 1)))
    assert [r.text for r in c.reasons] == ["boundary loops 0 and 1 meet (1→2 with 4→5, 1→2 with 7→4, 2→3 with 4→5, …)"]
    c = certify(np.empty((0, 3), int), CORNERS)
    assert c.short_repr() == "not injective, 0 of 0 triangles not positive"
    assert c.to_dict()["reasons"] == [{"kind": "no triangles", "text": "there are no triangles", "loops": []}]
    assert certify(np.tile(SQUARE[:, ::-1], (600, 1)), CORNERS, boundary=False).short_repr() == (
        "not injective, 1200 of 1200 triangles not positive"
    )


def test_predicate_and_locator_agree_with_the_certificate(rng, monkeypatch):
    monkeypatch.setattr("quasiharmonic.geometry.exact.triangles.TRIANGLE_CHUNK", 7)
    F = strip(6, rows=5)
    flat = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0), indexing="ij"), axis=-1).reshape(-1, 2)
    for noise in (0.0, 0.1, 0.4, 1.0):
        uv = flat + noise * rng.standard_normal(flat.shape)
        uv[3] = np.round(uv[3])
        signs = np.array([exact_orientation(*uv[t]) for t in F])
        c = certify(F, uv, boundary=False)
        np.testing.assert_array_equal(c.inverted, np.flatnonzero(signs < 0))
        np.testing.assert_array_equal(c.degenerate, np.flatnonzero(signs == 0))
        np.testing.assert_array_equal(inverted_triangles(F, uv), np.flatnonzero(signs <= 0))
        assert is_injective(F, uv) == c.injective == bool((signs > 0).all())
        assert c.bijective is None


@pytest.mark.parametrize("scale", [1e-310, 1e-150, 1e-12, 1.0, 1e12, 1e150, 1e305])
def test_verdicts_do_not_depend_on_scale(scale):
    F, uv = ring()
    assert certify(F, uv * scale).bijective
    uv[1] = uv[5]
    c = certify(F, uv * scale)
    assert c.degenerate.size + c.inverted.size == inverted_triangles(F, uv).size
    assert Obstacle.SELF_INTERSECTION in kinds(c)


def test_offset_of_a_hundred_million_times_the_size():
    F, uv = ring()
    uv = uv + 4e8  # exact enough in double precision, not in single precision
    assert certify(F, uv).bijective
    single = certify(F, uv.astype(np.float32))
    assert not single.injective
    assert single.degenerate.size


def test_dtypes_layouts_and_untouched_input():
    F, uv = ring()
    uv = np.round(uv * 64)
    for index in (np.int8, np.uint8, np.int32, np.uint64, ">i4"):
        for real in (np.float16, np.float32, np.longdouble, ">f8", np.int16):
            assert certify(F.astype(index), uv.astype(real)).bijective
    padded = np.zeros((len(uv), 5))
    padded[:, 1:4:2] = uv
    view = padded[:, 1:4:2]
    view.flags.writeable = False
    assert certify(np.asfortranarray(F), view).bijective
    assert certify(F.tolist(), uv.tolist()).bijective


def test_vertices_of_no_triangle_are_ignored():
    uv = np.vstack([CORNERS, [[np.nan, np.inf], [0.5, 0.5]]])
    assert certify(SQUARE, uv).bijective


@pytest.mark.parametrize(
    ("F", "uv", "said"),
    [
        (SQUARE[0], CORNERS, r"F must have shape \(f, 3\), triangles only, not \(3,\)"),
        (np.zeros((2, 4), int), CORNERS, r"F must have shape \(f, 3\), triangles only, not \(2, 4\)"),
        (SQUARE.astype(float), CORNERS, "F must contain integer indices, not float64"),
        (SQUARE.astype(bool), CORNERS, "F must contain integer indices, not bool"),
        (
            SQUARE + 1,
            CORNERS,
            r"F refers to vertex 4, but there are only vertices 0 … 3; if its indices count from 1, pass F - 1$",
        ),
        (np.arange(-9, 0).reshape(3, 3), CORNERS, r"vertices -9, -8, -7, -6, -5, … \(9 in all\)"),
        (SQUARE, CORNERS[:, :1], r"uv must have shape \(n, 2\), not \(4, 1\)"),
        (SQUARE, np.zeros((4, 3)), r"uv must have shape \(n, 2\), not \(4, 3\)"),
        (SQUARE, CORNERS.astype(complex), "uv must contain real numbers, not complex128"),
        (SQUARE, CORNERS.astype(int) * (2**53 + 1), "double precision at vertices 1, 2, 3"),
    ],
)
def test_malformed_input_is_named(F, uv, said):
    for function in (certify, is_injective, inverted_triangles):
        with pytest.raises(ValueError, match=said):
            function(F, uv)


def test_an_empty_mesh_is_not_injective():
    c = certify(np.empty((0, 3), int), np.empty((0, 2)))
    assert not c.injective
    assert c.bijective is False
    assert c.summary() == "Not injective: there are no triangles."
    assert not is_injective(np.empty((0, 3), int), CORNERS)


# --- the whole map ---


def test_bijective_disks_and_rings():
    assert certify(SQUARE, CORNERS).bijective
    assert certify(*spiral(turns=4, pitch=1.1)).bijective
    assert certify(*ring()).bijective
    c = certify(*together(square(0, 0, 1), square(2, 0, 1)))
    assert c.bijective
    assert len(c.loops) == 2
    # An island in a lake on an island.
    assert certify(*together(ring(3, 4), ring(1, 2), square(-0.4, -0.4, 0.8))).bijective


def test_a_ring_turned_inside_out_is_bijective():
    F, uv = ring()
    uv = uv * [1, -1] / (uv**2).sum(axis=1, keepdims=True)
    assert certify(F, uv).bijective


def test_a_band_that_overlaps_itself_is_injective_but_not_bijective():
    c = certify(*spiral(turns=1.5, pitch=0.5))
    assert c.injective
    assert c.bijective is False
    assert kinds(c) == {Obstacle.SELF_INTERSECTION}
    assert len(c.crossings)
    assert c.summary().startswith(
        "Injective: all 120 triangles are positive. Not bijective: boundary loop 0 meets itself ("
    )


def test_crossings_list_the_crossing_edges():
    F, uv = fan([[0, 0], [2, 2], [2, 0], [0, 2]], centre=(1, 1.5))
    c = certify(F, uv)
    np.testing.assert_array_equal(c.crossings, [[1, 2, 3, 4]])


@pytest.mark.parametrize(
    "polygon",
    [
        [[0, 0], [2, 0], [1, 0], [1, 1]],  # an edge that turns back along the previous one
        [[0, 0], [2, 0], [2, 0], [0, 2]],  # an edge of zero length
        [[0, 0], [1, 0], [2, 0]],  # all vertices collinear
        [[0, 0], [0, 0], [0, 0]],
        [[0, 0], [4, 0], [4, 2], [2, 0], [0, 2]],  # a vertex on an edge
        [[0, 0], [2, 1], [4, 0], [4, 2], [2, 1], [0, 2]],  # two vertices at the same position
    ],
)
def test_touching_is_not_simple(polygon):
    c = certify(*fan(polygon, centre=(1, 1)))
    assert Obstacle.SELF_INTERSECTION in kinds(c)
    # Each pair once, in the order of the boundary.
    rows = [tuple(row) for row in c.crossings.tolist()]
    assert rows == sorted(set(rows))
    assert rows


def test_inner_loop_outside_the_outer_one():
    F, uv = ring()
    uv[1::2] += [5, 0]
    c = certify(F, uv)
    assert c.inverted.size
    assert Obstacle.WINDING in kinds(c)
    assert [r.loops for r in c.reasons if r.kind is Obstacle.WINDING] == [(1,)]
    assert "loop 1 runs clockwise and no other loop is around it" in c.summary()


def test_inner_loop_touching_or_crossing_the_outer_one():
    for shift in (1.0, 1.5):
        F, uv = ring()
        uv[1::2] += [shift, 0]  # vertex 1 coincides with vertex 0, or passes it
        c = certify(F, uv)
        assert Obstacle.INTERSECTION in kinds(c)
        assert [r.loops for r in c.reasons if r.kind is Obstacle.INTERSECTION] == [(0, 1)]


def test_mirrored_map():
    c = certify(ring()[0], ring()[1] * [-1, 1])
    assert c.inverted.size == 24
    assert {Obstacle.WINDING, Obstacle.NESTING} <= kinds(c)


def test_loops_inside_others_are_named_with_them():
    inner = square(1, 1, 1)
    c = certify(*together(square(0, 0, 3), inner, square(5, 0, 1)))
    assert [(r.kind, r.loops) for r in c.reasons] == [(Obstacle.NESTING, (1, 0))]
    assert c.reasons[0].text == "boundary loop 1 runs counterclockwise inside 0: its interior is covered 2 times"
    F, uv = together(square(0, 0, 3), (inner[0][:, ::-1], inner[1]), square(-1, -1, 5))
    c = certify(F, uv)
    assert [(r.kind, r.loops) for r in c.reasons[1:]] == [(Obstacle.NESTING, (0, 2)), (Obstacle.NESTING, (1, 0, 2))]
    assert c.reasons[2].text == "boundary loop 1 runs clockwise inside 0, 2: its interior is covered 1 times"


def test_rays_that_cross_loops_in_several_portions(monkeypatch):
    """The ray from a vertex of the small square crosses the large loop three times."""
    monkeypatch.setattr("quasiharmonic.geometry.exact.loops.PAIR_CHUNK", 1)
    for x, bijective in ((-2, True), (0.5, False), (4.3, True), (7, False)):
        horns = fan([[0, 0], [9, 0], [9, 9], [7, 9], [4.5, 2], [2, 9], [0, 9]], centre=(4.5, 1))
        c = certify(*together(horns, square(x, 6, 0.3)))
        assert c.bijective == bijective
        assert kinds(c) == (set() if bijective else {Obstacle.NESTING})


def test_loops_that_begin_on_a_straight_side():
    """The orientation of a loop is that of a corner, never that of a straight angle."""
    side = np.array([[1.0, 0], [2, 0], [2, 2], [0, 2], [0, 0]])
    for turn in ([[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[-1, 0], [0, -1]], [[0, -1], [1, 0]]):
        for mirror in (1, -1):
            F, uv = together(fan(side, centre=(1, 1)), fan(side + 5, centre=(6, 6)))
            c = certify(F, uv @ turn * [mirror, 1])
            assert kinds(c) == (set() if mirror == 1 else {Obstacle.NOT_INJECTIVE, Obstacle.WINDING})


@pytest.mark.slow
def test_a_certificate_is_drawn():
    assert certify(SQUARE, CORNERS).plot().axes


def test_large_integers_that_are_doubles_are_accepted():
    assert certify([[0, 1, 2]], [[0, 0], [2**53, 0], [0, 2**54]]).bijective
    with pytest.raises(ValueError, match="does not fit double precision"):
        certify([[0, 1, 2]], [[0, 0], [2**53 + 1, 0], [0, 2**54]])
