"""The public functions with arbitrary arrays as arguments.

Each function either returns or raises a `ValueError` or `TypeError` with a message. A positive verdict is correct,
results are finite, arguments are unchanged, and there are no warnings (warnings are errors in the tests).
"""

from __future__ import annotations

import tempfile
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from quasiharmonic import (
    Problem,
    boundary_loops,
    certify,
    diagnose,
    distortion,
    injective_map,
    inverted_triangles,
    is_injective,
    polish,
    refine,
    refine_problem,
)
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.surfaces import annulus, disk, grid, random_delaunay
from quasiharmonic.ui.cli import main
from shared.damaged_files import VALID, damaged
from shared.examples import examples
from shared.meshes import boundary_of, signed_areas

pytestmark = pytest.mark.long

often = examples(35, suppress_health_check=[HealthCheck.too_slow])
seldom = examples(15, suppress_health_check=[HealthCheck.too_slow])

MESHES = [
    (np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])),
    grid(2, 2),
    disk(2),
    annulus(3),
    random_delaunay(25, seed=1),
    (np.eye(3)[:, :2], np.array([[0, 1, 2]])),
]
HUGE = [2**15, 2**31 - 1, 2**31, 2**40, 2**62, 2**63 - 1, -1, -2, -(2**31), -(2**63)]
NUMBERS = [
    0.0,
    -0.0,
    1.0,
    5e-324,
    1e-300,
    1e-150,
    1e-12,
    1e12,
    1e150,
    1e300,
    1.7e308,
    -1.7e308,
    np.inf,
    -np.inf,
    np.nan,
]


def outcome(function, *arguments, **more):
    """Return the result, or None if the function raises an error with a message; check that arguments are unchanged."""
    given = [a.copy() for a in (*arguments, *more.values()) if isinstance(a, np.ndarray)]
    message = "none is needed"
    try:
        result = function(*arguments, **more)
    except (ValueError, TypeError) as error:
        result, message = None, str(error)
    assert message
    for before, after in zip(
        given, (a for a in (*arguments, *more.values()) if isinstance(a, np.ndarray)), strict=True
    ):
        assert before.dtype == after.dtype
        # Object arrays may contain anything, NaN included.
        assert before.dtype == object or before.tobytes() == after.tobytes()
    event("refused" if result is None else "accepted")
    return result


def dressed(draw, array):
    """The same numbers in another type or layout, possibly read-only."""
    how = draw(st.sampled_from(["plain", "plain", "fortran", "strided", "backwards", "swapped", "read-only", "list"]))
    if not array.ndim:
        return array
    if how == "fortran":
        return np.asfortranarray(array)
    if how == "strided":
        return np.repeat(array, 2, axis=0)[::2]
    if how == "backwards":
        return array[::-1].copy()[::-1]
    if how == "swapped" and array.dtype.kind in "iuf":
        return array.astype(array.dtype.newbyteorder())
    if how == "read-only":
        array = array.copy()
        array.flags.writeable = False
    return array.tolist() if how == "list" else array


@st.composite
def positions(draw, good, wrong=3):
    """Vertex positions of random type and layout; one in ``wrong`` is invalid."""
    array = np.array(good, dtype=float)
    spoiled = draw(st.integers(1, wrong)) == wrong
    for _ in range(draw(st.integers(0, 2 * spoiled))):
        if array.size:
            array.flat[draw(st.integers(0, array.size - 1))] = draw(st.sampled_from(NUMBERS))
    with np.errstate(all="ignore"):
        array = array * draw(st.sampled_from([1.0, 1.0, 1.0, 1e-300, 1e-150, 1e-12, 1e12, 1e150]))
    dtype = draw(
        st.sampled_from(
            [float] * 6 + [np.float32, np.float16, np.longdouble, int, np.uint8, bool, object, complex, str]
        )
    )
    if dtype is not float:
        with np.errstate(all="ignore"):
            finite = np.where(np.isfinite(array) & (np.abs(array) < 1e18), array, 0)
            array = (finite if dtype in (int, np.uint8) else array).astype(dtype)
    shapes = ["same", "flat", "short", "wide", "deep", "empty", "number"]
    shape = draw(st.sampled_from(shapes)) if spoiled else "same"
    array = {
        "same": lambda: array,
        "flat": lambda: array.ravel(),
        "short": lambda: array[:-1],
        "wide": lambda: np.hstack([array, array]),
        "deep": lambda: array[None],
        "empty": lambda: array[:0],
        "number": lambda: np.array(1.5),
    }[shape]()
    return dressed(draw, array)


@st.composite
def indices(draw, good, n, wrong=3):
    """Indices of random type and layout; one in ``wrong`` is invalid."""
    array = np.array(good, dtype=np.int64)
    spoiled = draw(st.integers(1, wrong)) == wrong
    for _ in range(draw(st.integers(0, 2 * spoiled))):
        if array.size:
            at = draw(st.integers(0, array.size - 1))
            array.flat[at] = draw(st.one_of(st.integers(-1, n + 1), st.sampled_from(HUGE)))
    changes = ["none"] * 3 + ["repeat", "drop", "shuffle", "turn", "empty", "flat", "deep"]
    change = draw(st.sampled_from(changes)) if spoiled else "none"
    if array.size:
        row = draw(st.integers(0, len(array) - 1))
        if change == "repeat":
            array = np.concatenate([array, array[row : row + 1]])
        elif change == "drop":
            array = np.delete(array, row, axis=0)
        elif change == "shuffle":
            array = array[np.random.default_rng(row).permutation(len(array))]
        elif change == "turn":
            array[row] = array[row, ::-1] if array.ndim == 2 else array[0]
        elif change in ("empty", "flat", "deep"):
            array = {"empty": array[:0], "flat": array.ravel(), "deep": array[None]}[change]
    whole = [np.int64] * 6 + [np.int32, np.int16, np.uint8, np.uint64]
    dtype = draw(st.sampled_from([*whole, float, bool, object, str] if spoiled else whole))
    with np.errstate(all="ignore"):
        array = array.astype(dtype)
    return dressed(draw, array)


@st.composite
def problems(draw, wrong=4):
    """Arguments of `Problem`: a mesh, its boundary, possibly pins, and target positions."""
    V, F = draw(st.sampled_from(MESHES))
    fixed = boundary_of(F)
    inside = np.setdiff1d(np.arange(len(V)), fixed)
    pins = inside[
        np.random.default_rng(draw(st.integers(0, 99))).random(len(inside)) < draw(st.sampled_from([0, 0, 0.3, 1]))
    ]
    fixed = np.concatenate([fixed, pins])
    target = V[fixed]
    kind = draw(st.sampled_from(["own", "noise", "random", "grid", "turned", "mirrored", "point"]))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    if kind == "noise":
        target = target + 0.2 * rng.normal(size=target.shape)
    elif kind == "random":
        target = rng.normal(size=target.shape)
    elif kind == "grid":
        target = rng.integers(-2, 3, target.shape).astype(float)
    elif kind == "turned":
        target = target * [-1, -1] if rng.random() < 0.5 else np.roll(target, 3, axis=0)
    elif kind == "mirrored":
        target = target * [1, -1]
    elif kind == "point":
        target = np.zeros_like(target)
    reference = draw(st.sampled_from([None, None, "equilateral", "equilateral", "rest", "corrected", "square", 3]))
    n = len(V)
    return (
        draw(positions(V, wrong)),
        draw(indices(F, n, wrong)),
        draw(indices(fixed, n, wrong)),
        draw(positions(target, wrong)),
        {"reference": reference},
    )


@often
@given(problems())
def test_problem_and_diagnosis(arguments):
    *arrays_, more = arguments
    problem = outcome(Problem, *arrays_, **more)
    if problem is None:
        return
    for name, kind in (("V", "f"), ("F", "i"), ("fixed", "i"), ("target", "f")):
        array = getattr(problem, name)
        assert array.dtype.kind == kind
        assert array.dtype.itemsize == 8
        assert np.isfinite(array).all()
        assert not array.flags.writeable
    diagnosis = diagnose(problem)
    assert diagnosis.summary()
    n = problem.n
    for found in diagnosis.obstructions:
        for elements, count in (
            (found.vertices, n),
            (found.edges, n),
            (found.split, n),
            (found.triangles, len(problem.F)),
        ):
            assert np.all((elements >= 0) & (elements < count))
    interior = {tuple(edge) for edge in problem.domain.edges.interior.tolist()}
    assert {tuple(edge) for edge in diagnosis.split.tolist()} <= interior
    if more["reference"] == "equilateral":
        refined = refine_problem(problem, max_rounds=1)
        assert np.isfinite(refined.problem.V).all()


@seldom
@given(problems(wrong=12), st.integers(1, 3), st.sampled_from(["speed", "paper"]))
def test_injective_map(arguments, iterations, strategy):
    *arrays_, more = arguments
    result = outcome(injective_map, *arrays_, **more, strategy=strategy, max_iterations=iterations)
    if result is None:
        return
    F, fixed = np.asarray(arrays_[1]).astype(np.int64), np.asarray(arrays_[2]).astype(np.int64)
    assert np.isfinite(result.uv).all()
    np.testing.assert_array_equal(result.uv[fixed], np.asarray(arrays_[3]).astype(float))
    a, b, c = result.uv[F].transpose(1, 0, 2)
    assert result.injective == bool((orientation(a, b, c) > 0).all())
    assert result.status.value
    if result.diagnosis is not None and result.diagnosis.forbids_injective:
        assert not result.injective


@often
@given(st.data())
def test_certificate(data):
    V, F = data.draw(st.sampled_from(MESHES))
    places, triangles = data.draw(positions(V)), data.draw(indices(F, len(V)))
    certificate = outcome(certify, triangles, places)
    inverted = outcome(inverted_triangles, triangles, places)
    good = outcome(is_injective, triangles, places)
    assert (certificate is None) == (inverted is None) == (good is None)
    if certificate is None:
        return
    assert certificate.summary()
    assert certificate.injective == good
    bad = np.concatenate([certificate.inverted, certificate.degenerate, certificate.nonfinite])
    np.testing.assert_array_equal(np.sort(bad), inverted)
    if certificate.bijective:
        assert certificate.injective
    uv, corners = np.asarray(places).astype(np.float64), np.asarray(triangles).astype(np.int64)
    if good:
        assert len(corners)
        assert np.isfinite(uv[corners]).all()
        if np.abs(uv).max() < 1e100 and np.ptp(uv[corners]) > 1e-100:
            # Where rounding cannot matter, the plain formula agrees.
            areas = signed_areas(corners, uv)
            assert (areas > -1e-12 * np.ptp(uv[corners]) ** 2).all()


@often
@given(st.data())
def test_distortion(data):
    V, F = data.draw(st.sampled_from(MESHES))
    result = outcome(distortion, data.draw(positions(V)), data.draw(indices(F, len(V))), data.draw(positions(V)))
    if result is not None:
        assert result.to_dict()
        assert len(result.sigma1) == len(result.mips)


@seldom
@given(st.data())
def test_polish(data):
    V, F = data.draw(st.sampled_from(MESHES))
    n, fixed = len(V), boundary_of(F)
    arguments = [data.draw(positions(V, 12)), data.draw(indices(F, n, 12)), data.draw(positions(V, 12))]
    energy = data.draw(st.sampled_from(["symmetric-dirichlet", "mips", "arap-barrier", "blend", "none", 1]))
    result = outcome(polish, *arguments, fixed=data.draw(indices(fixed, n, 12)), energy=energy, max_iterations=3)
    if result is not None:
        assert result.injective
        assert np.isfinite(result.uv).all()
        assert is_injective(np.asarray(arguments[1]).astype(np.int64), result.uv)


@often
@given(st.data())
def test_refinement(data):
    V, F = data.draw(st.sampled_from(MESHES))
    n = len(V)
    pairs = np.concatenate([np.stack([F[:, 0], F[:, 1]], axis=1)[:3], np.zeros((0, 2), dtype=np.int64)])
    arguments = data.draw(positions(V)), data.draw(indices(F, n)), data.draw(indices(pairs, n))
    result = outcome(refine, *arguments, boundary=data.draw(st.booleans()))
    if result is not None:
        assert np.isfinite(result.V).all()
        assert len(result.V) == len(arguments[0]) + len(result.parents)
        assert result.F.size == 0 or (0 <= result.F.min() <= result.F.max() < len(result.V))
        assert len(result.parent) == len(result.F)


@often
@given(st.data())
def test_arrays_of_any_kind(data):
    """Arrays that need not form a mesh."""
    anything = st.one_of(
        arrays.arrays(
            data.draw(st.sampled_from([np.float64, np.int64, np.uint64, bool, np.complex128, "U3", "datetime64[s]"])),
            arrays.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
        ),
        st.none(),
        st.integers(-3, 3),
        st.text(max_size=3),
        st.lists(st.lists(st.integers(-1, 4), max_size=4), max_size=4),
        st.just({}),
    )
    one, two, three, four = (data.draw(anything) for _ in range(4))
    outcome(Problem, one, two, three, four)
    outcome(certify, two, one)
    outcome(inverted_triangles, two, one)
    outcome(distortion, one, two, three)
    outcome(refine, one, two, three)
    outcome(polish, one, two, four, fixed=three)
    outcome(injective_map, one, two, three, four, max_iterations=1)


@pytest.mark.parametrize("name", ["fuzz.obj", "regular.obj", "fuzz.off"])
@seldom
@given(data=st.data())
def test_command_on_damaged_files(name, data):
    """The command ends with a documented exit status and a message for any file content."""
    text = data.draw(damaged(VALID[name]))
    handles = data.draw(st.one_of(st.none(), damaged(VALID["handles.txt"])))
    command = data.draw(st.sampled_from(["map", "check", "refine", "polish"]))
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / name, Path(folder) / "out.obj"
        source.write_bytes(text)
        arguments = [command, str(source)]
        if command in ("map", "refine", "polish"):
            arguments += ["-o", str(out)]
        if command in ("map", "polish"):
            arguments += ["--max-iterations", "1"]
        if command != "check" and handles is not None:
            listed = Path(folder) / "handles.txt"
            listed.write_bytes(handles)
            arguments += ["--fixed", str(listed)]
        said, complained = StringIO(), StringIO()
        with redirect_stdout(said), redirect_stderr(complained):
            status = main(arguments)
        event(f"{command} {status}")
        assert status in (0, 1, 2)
        assert (said if status < 2 else complained).getvalue()
        assert out.exists() == ("-o" in arguments and status < 2)


def test_indices_of_any_size_are_named():
    V, F = grid(2, 2)
    for dtype in (np.int8, np.int64, np.uint8, np.uint64):
        wrong = F.astype(dtype)
        wrong[3, 1] = np.iinfo(dtype).max
        for function in (lambda F: certify(F, V), lambda F: Problem(V, F, boundary_of(grid(2, 2)[1]), V[:8])):
            with pytest.raises(ValueError, match="F refers to vert"):
                function(wrong)


def test_loops_of_zero_length():
    assert boundary_loops(np.empty((0, 3), dtype=np.int64), 0) == []
