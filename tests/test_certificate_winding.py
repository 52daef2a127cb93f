"""The certificate of bijectivity: fans wound several times, branched sheets, islands, what is not a surface."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quasiharmonic import certify, injective_map
from quasiharmonic.geometry.exact.certificate import Obstacle
from quasiharmonic.geometry.exact.predicates import SegmentRelation
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.surfaces import annulus
from shared.exact import exact_orientation, exact_relation, integers
from shared.examples import examples
from shared.sheets import CORNERS, SQUARE, fan, kinds, polar, ring, spiral, square, strip, together


def crossed_sheets():
    """A ring of positive triangles with two branch points: a disk and a smaller one above it, joined crosswise.

    The slit is at y = 3 from x = 2 to x = 4. A path across it changes from one sheet to the other.
    """
    place, number = [], {}

    def vertex(sheet, x, y, above):
        if y == 3 and x in (2, 4):
            key = ("end", x, y)
        elif y == 3 and x == 3:
            key = ("slit", sheet == above, x)
        else:
            key = (sheet, x, y)
        if key not in number:
            number[key] = len(place)
            place.append((float(x), float(y)))
        return number[key]

    faces = []
    for sheet, low, high in ((0, 0, 6), (1, 1, 5)):
        for x, y in itertools.product(range(low, high), repeat=2):
            a, b, c, d = (vertex(sheet, x + i, y + j, y >= 3) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
            faces += [(a, b, c), (a, c, d)]
    return np.array(faces), np.array(place), sorted(number["end", x, 3] for x in (2, 4))


def covers_nothing_twice(F, uv):
    """Decide injectivity by comparing all pairs of triangles in rational arithmetic."""
    if any(exact_orientation(*uv[t]) <= 0 for t in F):
        return False
    for s, t in itertools.combinations(F.tolist(), 2):
        edges_s, edges_t = ([(f[i], f[(i + 1) % 3]) for i in range(3)] for f in (s, t))
        apart = any(
            all(exact_orientation(uv[i], uv[j], uv[v]) <= 0 for v in other)
            for own, other in ((edges_s, t), (edges_t, s))
            for i, j in own
        )
        if not apart:
            return False
        for (i, j), (k, m) in itertools.product(edges_s, edges_t):
            shared = {i, j} & {k, m}
            relation = exact_relation(uv[i], uv[j], uv[k], uv[m])
            allowed = (SegmentRelation.DISJOINT, SegmentRelation.TOUCHING, SegmentRelation.OVERLAPPING)[len(shared)]
            if relation != allowed:
                return False
    return True


def test_a_fan_wound_twice():
    for start in np.linspace(0, 1, 7):
        t = start + np.arange(10) / 5
        c = certify(*fan(polar(np.linspace(1, 2, 10), t)))
        assert c.injective
        assert c.bijective is False
        np.testing.assert_array_equal(c.multiply_wound, [0])
        assert kinds(c) == {Obstacle.SELF_INTERSECTION, Obstacle.MULTIPLY_WOUND}
        assert c.reasons[-1].text == "triangles wind more than once around vertex 0"


def test_a_fan_wound_once_is_not_multiply_wound(rng):
    for _ in range(20):
        t = np.sort(rng.random(9)) if rng.random() < 0.5 else (np.arange(8) / 8)
        uv = polar(rng.uniform(1, 2, len(t)), t)
        assert not certify(*fan(np.round(uv, 1))).multiply_wound.size


def test_only_vertices_with_positive_triangles_are_multiply_wound():
    F, uv = fan(polar(np.linspace(1, 2, 12), np.arange(12) / 5))
    c = certify(F[:-1], uv)  # vertex 0 is on the boundary now
    assert c.injective
    assert kinds(c) == {Obstacle.SELF_INTERSECTION, Obstacle.MULTIPLY_WOUND}
    np.testing.assert_array_equal(c.multiply_wound, [0])
    t = np.array([0, 0.3, 0.6, 0.5, 0.8, 1.1, 1.4, 1.7])
    c = certify(*fan(polar(np.linspace(1, 2, 8), t)))
    np.testing.assert_array_equal(c.inverted, [2])
    assert not c.multiply_wound.size
    F, uv = fan(polar(np.ones(11), np.array([0, 1, 1, 2, 3, 4, 5, 6, 7, 8, 9]) / 5))
    uv[3] = 2 * uv[2]
    c = certify(F, uv)
    np.testing.assert_array_equal(c.degenerate, [1])
    assert not c.inverted.size
    assert not c.multiply_wound.size


def overwound_exactly(F, uv):
    """Vertices with positive triangles only, whose angles sum to more than 2π, in integers."""
    numbers, found = integers(*uv.ravel()), []
    places = list(zip(numbers[::2], numbers[1::2], strict=True))
    for v in np.unique(F).tolist():
        rows = [np.roll(t, -int(np.argmax(t == v))).tolist() for t in F if v in t]
        if any(exact_orientation(*uv[row]) <= 0 for row in rows):
            continue
        following = {b: c for _, b, c in rows}
        # An open fan begins with the triangle that has no predecessor; a closed fan begins anywhere.
        here = next((b for b in following if b not in following.values()), rows[0][1])
        x, y, whole = 1, 0, 0
        for _ in rows:
            (bx, by), (cx, cy) = (
                [p - q for p, q in zip(places[i], places[v], strict=True)] for i in (here, following[here])
            )
            dx, dy = bx * cx + by * cy, bx * cy - by * cx
            lower = y < 0 or (y == 0 and x < 0)
            x, y = x * dx - y * dy, x * dy + y * dx
            # Steps are less than half a turn, so a step from the lower to the upper half completes a turn.
            whole += lower and (y > 0 or (y == 0 and x > 0))
            here = following[here]
        if whole > 1 or (whole == 1 and (y != 0 or x < 0)):
            found.append(v)
    return found


def open_fan(rng, triangles):
    """Positive triangles with integer coordinates around the boundary vertex 0."""
    points = [rng.integers(-2, 3, 2)]
    while len(points) <= triangles:
        place = rng.integers(-2, 3, 2)
        x, y = points[-1]
        if x * place[1] - y * place[0] > 0:
            points.append(place)
        elif not points[-1].any():
            points = [place]
    rim = np.arange(1, triangles + 1)
    return np.stack([np.zeros_like(rim), rim, rim + 1], axis=1), np.vstack([[0, 0], points]).astype(float)


@pytest.mark.slow
def test_boundary_vertices_with_multiply_wound_triangles(rng):
    counted = {True: 0, False: 0}
    for _ in range(75):
        F, uv = open_fan(rng, int(rng.integers(2, 9)))
        F, uv = F[rng.permutation(len(F))], uv * rng.choice([1.0, 1e-200, 3e150])
        # Any corner of a triangle may be the first one.
        F = np.array([np.roll(t, by) for t, by in zip(F, rng.integers(0, 3, len(F)), strict=True)])
        c = certify(F, uv)
        assert c.injective
        np.testing.assert_array_equal(c.multiply_wound, overwound_exactly(F, uv))
        assert (Obstacle.MULTIPLY_WOUND in kinds(c)) == bool(c.multiply_wound.size)
        assert not (c.bijective and c.multiply_wound.size)
        counted[bool(c.multiply_wound.size)] += 1
    assert counted[True] > 20
    assert counted[False] > 20


@pytest.mark.slow
def test_maps_of_annuli_that_are_multiply_wound_or_not(rng):
    """Rings with integer coordinates, some torn, some with a loop reflected; a third have inverted triangles."""
    seen = 0
    for _ in range(60):
        columns = int(rng.integers(4, 9))
        F, uv = ring(columns=columns)
        if rng.random() < 0.6:
            uv[1::2] *= [-0.5, 0.5]
        uv = np.round(uv * 8) + rng.integers(-2, 3, uv.shape)
        if rng.random() < 0.3:
            F = F[:-2]
        F = np.roll(F, int(rng.integers(3)), axis=1)
        c = certify(F, uv)
        np.testing.assert_array_equal(c.multiply_wound, [] if c.bijective else overwound_exactly(F, uv))
        assert not (c.bijective and overwound_exactly(F, uv))
        seen += bool(c.multiply_wound.size)
    assert seen


def test_an_annulus_with_its_inner_loop_reflected():
    V, F = annulus(6)
    outer, inner = sorted(boundary_loops(F, len(V)), key=lambda loop: -np.abs(V[loop]).max())
    target = np.concatenate([V[outer], V[inner] * [-0.5, 0.5]])
    result = injective_map(V, F, np.concatenate([outer, inner]), target)
    c = result.certificate
    assert c.injective
    assert not c.bijective
    assert c.multiply_wound.tolist() == [21, 38] == overwound_exactly(F, result.uv)
    assert set(c.multiply_wound) <= set(inner)
    assert "triangles wind more than once around vertices 21, 38" in result.summary()
    assert c.to_dict()["multiply_wound"] == [21, 38]


def test_a_closed_slit_is_not_multiply_wound():
    """The angles at its end sum to exactly 2π. Its sides coincide, which is a crossing."""
    t = np.arange(9) / 8
    F, uv = fan(np.round(polar(1 + 0 * t, t) * 4))
    for turn in range(8):
        # Vertices 9 and 1 coincide.
        np.testing.assert_array_equal(uv[1], uv[9])
        turned = uv @ [[[1, 0], [0, 1]], [[0, 1], [-1, 0]], [[3, 4], [-4, 3]], [[5, -12], [12, 5]]][turn % 4]
        c = certify(F[:-1], turned)
        assert c.injective
        assert not c.multiply_wound.size
        assert len(c.crossings)
        turned[9] += (turned[2] - turned[9]) * 2.0**-40
        assert certify(F[:-1], turned).multiply_wound.tolist() == [0]
        turned[9] += (turned[8] - turned[9]) * 2.0**-30
        assert not certify(F[:-1], turned).multiply_wound.size


def test_branched_sheets_with_simple_and_disjoint_loops():
    F, uv, branches = crossed_sheets()
    c = certify(F, uv)
    assert c.injective
    assert c.bijective is False
    assert not len(c.crossings)
    np.testing.assert_array_equal(c.multiply_wound, branches)
    assert kinds(c) == {Obstacle.NESTING, Obstacle.MULTIPLY_WOUND}
    assert "covered 2 times" in c.summary()


@pytest.mark.parametrize(
    ("parts", "kind"),
    [
        ((square(0, 0, 2), square(1, 1, 2)), Obstacle.INTERSECTION),
        ((square(0, 0, 2), square(2, 2, 2)), Obstacle.INTERSECTION),
        ((square(0, 0, 2), square(2, 0.5, 1)), Obstacle.INTERSECTION),
        ((square(0, 0, 2), square(0, 0, 2)), Obstacle.INTERSECTION),
        ((square(0, 0, 3), square(1, 1, 1)), Obstacle.NESTING),
    ],
)
def test_islands_that_overlap_or_touch(parts, kind):
    c = certify(*together(*parts))
    assert c.injective
    assert c.bijective is False
    assert kinds(c) == {kind}


@pytest.mark.parametrize(
    ("F", "said"),
    [
        ([[0, 1, 2], [0, 3, 1], [0, 1, 4]], r"edges are in three or more triangles (0–1)"),
        ([[0, 1, 2], [0, 1, 3]], "edges are traversed twice in the same direction (0–1)"),
        ([[0, 1, 2], [0, 1, 1]], "triangles repeat a vertex (1)"),
        ([[0, 0, 1], [2, 3, 4]], "triangles repeat a vertex (0)"),
        ([[2, 3, 4], [1, 0, 1]], "triangles repeat a vertex (1)"),
        ([[0, 1, 2], [2, 3, 4]], "passes more than once through vertex 2"),
    ],
)
def test_meshes_that_are_not_surfaces(F, said):
    uv = np.array([[0.0, 0], [4, 0], [2, 1], [3, 2], [1, 2]])
    c = certify(F, uv)
    assert c.bijective is False
    assert Obstacle.NOT_A_SURFACE in kinds(c)
    assert said in c.summary()
    assert c.injective == all(exact_orientation(*uv[t]) > 0 for t in F)


def test_a_closed_surface():
    F = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    c = certify(F, np.array([[0.0, 0], [3, 0], [0, 3], [1, 1]]))
    np.testing.assert_array_equal(c.inverted, [0])
    assert kinds(c) == {Obstacle.NOT_INJECTIVE, Obstacle.NO_BOUNDARY}
    assert c.reasons[-1].text == "the surface has no boundary"


def test_boundary_that_is_not_finite():
    uv = CORNERS.copy()
    uv[2] = np.nan
    c = certify(SQUARE, uv)
    assert c.bijective is False
    assert kinds(c) == {Obstacle.NOT_INJECTIVE}


@pytest.mark.slow
def test_a_collapsed_map_is_certified_quickly():
    F, uv = ring(columns=20_000)
    c = certify(F, np.zeros_like(uv))
    assert c.degenerate.size == len(F)
    assert 0 < len(c.crossings) <= 1000


@pytest.mark.slow
def test_many_loops_and_long_loops():
    holes = [ring(1, 1.5, columns=5)[1] + [4 * i, 4 * j] for i in range(15) for j in range(15)]
    F = ring(columns=5)[0]
    assert certify(*together(*((F, uv) for uv in holes))).bijective
    assert certify(*together(*((F, uv) for uv in holes), square(-3, -3, 70))).reasons[0].kind is Obstacle.NESTING
    assert certify(*ring(columns=30_000)).bijective


def test_certificate_is_frozen_and_serialisable():
    F, uv, _ = crossed_sheets()
    for c in (certify(F, uv), certify(F, uv * [-1, 1]), certify(SQUARE, CORNERS, boundary=False), certify(*ring())):
        told = json.loads(json.dumps(c.to_dict()))
        assert told["injective"] == c.injective
        assert told["bijective"] == c.bijective
        assert told["inverted"] == c.inverted.tolist()
        assert len(told["reasons"]) == len(c.reasons)
        assert [str(r) for r in c.reasons] == [r["text"] for r in told["reasons"]]
    assert told["loops"] == [{"start": 0, "length": 12}, {"start": 1, "length": 12}]
    with pytest.raises(ValueError, match="read-only"):
        c.inverted[:] = 0
    arrays = [value for value in vars(c).values() if isinstance(value, np.ndarray)]
    for array in (*arrays, *c.loops):
        assert not array.flags.writeable
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            array.flags.writeable = True
    with pytest.raises(AttributeError):
        c.triangles = 3


# --- against slower methods


@pytest.mark.slow
@given(st.data())
@examples(30)
def test_bijective_if_no_triangles_share_more_than_their_vertices(data):
    base = data.draw(st.sampled_from(["band", "ring", "fan", "islands"]))
    if base == "band":
        turns = data.draw(st.sampled_from([0.5, 0.9, 1.0, 1.2]))
        F, uv = spiral(turns, pitch=data.draw(st.sampled_from([0.0, 0.5, 1.0, 1.5])), columns=7)
    elif base == "ring":
        F, uv = ring(inner=data.draw(st.sampled_from([0.25, 1.0, 1.75])), columns=5)
    elif base == "fan":
        k, turns = data.draw(st.sampled_from([(5, 1), (7, 2)]))
        F, uv = fan(
            polar(
                np.array(data.draw(st.lists(st.integers(4, 8), min_size=k, max_size=k))) / 4, np.arange(k) * turns / k
            )
        )
    else:
        shift = data.draw(st.tuples(*[st.sampled_from([-3, -1.5, -1, 0, 0.5, 2.25])] * 2))
        F, uv = together(ring(columns=4), square(*shift, 0.75))
    # A coarse lattice makes touching and collinear cases likely.
    cells = data.draw(st.sampled_from([2, 4, 64]))
    uv = np.round(uv * cells) / cells
    moved = data.draw(st.integers(0, len(uv) - 1))
    uv[moved] += np.array(data.draw(st.tuples(*[st.integers(-1, 1)] * 2))) / cells
    assert certify(F, uv).bijective == covers_nothing_twice(F, uv)


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=3, max_size=8))
@examples(50)
def test_polygons_agree_with_all_pairs_of_edges(polygon):
    k = len(polygon)
    places = np.array(polygon, dtype=float)
    relation = {
        (i, j): exact_relation(places[i], places[(i + 1) % k], places[j], places[(j + 1) % k])
        for i, j in itertools.combinations(range(k), 2)
    }
    simple = len(set(polygon)) == k and all(
        value == (SegmentRelation.TOUCHING if j - i in (1, k - 1) else SegmentRelation.DISJOINT)
        for (i, j), value in relation.items()
    )
    found = kinds(certify(*fan(places, centre=(0.5, 1.25))))
    assert (Obstacle.SELF_INTERSECTION not in found) == simple
    if simple:
        x, y = places.T
        assert (Obstacle.WINDING in found) == (np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0)


@pytest.mark.slow
def test_every_triangle_agrees_with_rational_arithmetic(rng):
    F = strip(9, rows=9)
    flat = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0), indexing="ij"), axis=-1).reshape(-1, 2)
    for scale, offset, noise in itertools.product([5e-324, 1e-300, 1e-150, 1, 1e150, 1e307], [0, 1e8], [0, 1e-16, 0.3]):
        uv = (flat + offset * (scale == 1) + noise * rng.standard_normal(flat.shape)) * scale
        uv[:, 1] = np.where(rng.random(len(uv)) < 0.3, uv[:, 0], uv[:, 1])
        signs = np.array([exact_orientation(*uv[t]) for t in F])
        c = certify(F, uv)
        np.testing.assert_array_equal(c.inverted, np.flatnonzero(signs < 0))
        np.testing.assert_array_equal(c.degenerate, np.flatnonzero(signs == 0))
