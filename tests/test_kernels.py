"""Every compiled kernel agrees with its NumPy version and rejects unsuitable arrays."""

from __future__ import annotations

import ctypes
import os
import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import quasiharmonic
from quasiharmonic import certify
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP
from quasiharmonic.geometry.mesh.reference import ReferenceMesh, rest_frames, rest_shapes
from quasiharmonic.geometry.mesh.topology import boundary_loops, components
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.solver.field.tensor import TANH
from quasiharmonic.surfaces import disk
from quasiharmonic.util import kernels
from quasiharmonic.util.kernels.constants import shared_constants
from shared.kernel_arguments import ARGUMENTS

# Packages that require extras and have no kernels.
_WITHOUT = "torch", "jax", "notebook", "studio", "batch", "report"
for module in pkgutil.walk_packages(quasiharmonic.__path__, "quasiharmonic."):
    if not {*_WITHOUT, "__main__"} & {*module.name.split(".")}:
        import_module(module.name)

needs_extension = pytest.mark.skipif(kernels.extension is None, reason="the extension is not built, or switched off")
CASES = [pytest.param(name, make, id=f"{name}-{i}") for name, some in ARGUMENTS.items() for i, make in enumerate(some)]


def outcome(kernel, arguments):
    """Return a kernel's arguments after the call, and its result; the arguments are copies with the original layout."""
    given = [each.copy() if isinstance(each, np.ndarray) and each.flags.writeable else each for each in arguments]
    return [*given, kernel(*given)]


def same(one, other):
    """Compare arrays: integers exactly, floats up to rounding relative to their neighbours."""
    if isinstance(one, np.ndarray) and one.dtype.kind in "fc":
        scale = np.abs(one[np.isfinite(one)]).max(initial=0)
        with np.errstate(all="ignore"):  # of infinities, by NumPy 1
            return np.allclose(one, other, rtol=1e-11, atol=1e-14 * scale, equal_nan=True)
    return one == pytest.approx(other, rel=1e-11) if isinstance(one, float) else np.array_equal(one, other)


def test_every_kernel_has_test_arguments():
    assert set(ARGUMENTS) == set(kernels.TWINS)


@needs_extension
def test_every_kernel_has_a_numpy_version():
    assert {name for name in dir(kernels.extension) if not name.startswith("_")} == {"constants", *kernels.TWINS}


@needs_extension
@pytest.mark.parametrize(("name", "make"), CASES)
def test_both_versions_agree(name, make):
    for seed in range(3):
        arguments = make(np.random.default_rng(seed))
        with np.errstate(all="ignore"):
            expected = outcome(kernels.TWINS[name], arguments)
        got = outcome(getattr(kernels.extension, name), arguments)
        assert [same(one, other) for one, other in zip(expected, got, strict=True)] == [True] * len(got)


@needs_extension
@pytest.mark.parametrize(("name", "make"), CASES)
def test_integers_of_32_bits_serve_as_well(name, make):
    """NumPy 1 on Windows makes them by default."""

    def narrow(given):
        fits = getattr(given, "dtype", None) == np.int64 and np.array_equal(given, given.astype(np.int32))
        return given.astype(np.int32) if fits else given

    arguments = make(np.random.default_rng(0))
    for given in arguments:  # what a kernel does not set is equal in both calls
        if isinstance(given, np.ndarray) and given.flags.writeable and given.dtype == np.int64:
            given[np.abs(given) > 2**40] = 0
    kernel = getattr(kernels.extension, name)
    expected, got = outcome(kernel, arguments), outcome(kernel, [narrow(each) for each in arguments])
    assert [same(one, other) for one, other in zip(expected, got, strict=True)] == [True] * len(got)


@needs_extension
@pytest.mark.parametrize(("name", "make"), CASES)
def test_unsuitable_arrays_are_rejected(name, make):
    """Another type for any of them, one argument too few, one too many."""
    kernel, arguments = getattr(kernels.extension, name), make(np.random.default_rng(0))
    for i, each in enumerate(arguments):
        if isinstance(each, np.ndarray):
            with pytest.raises(TypeError, match=name):
                kernel(*arguments[:i], np.zeros(each.shape, dtype=np.float32), *arguments[i + 1 :])
    for wrong in (arguments[:-1], (*arguments, arguments[-1]), ()):
        with pytest.raises(TypeError, match=f"{name} was given {len(wrong)} arguments"):
            kernel(*wrong)


@needs_extension
def test_an_explicit_byte_order_is_accepted():
    """Arrays from `ctypes` have one, and so do copies of them."""
    V, F = disk(3)
    named = np.ctypeslib.as_array((ctypes.c_double * V.size)(*V.ravel().tolist())).reshape(V.shape)
    assert memoryview(named.copy()).format in ("<d", ">d")
    alike, other = rest_shapes(V, F), rest_shapes(named, F)
    assert np.array_equal(alike.m, other.m)
    with pytest.raises(TypeError, match="lay_flat"):
        rest_frames(V.astype(V.dtype.newbyteorder()), F)


# Arrays, by number, that may have many lengths: space for results, and arrays that indices refer to.
_ANY_LENGTH = {
    "wirtinger": {0},
    "lay_flat": {0},
    "sort_edges": {0},
    "number_sides": {0},
    "link_nodes": {2},
    "fill_cells": {2},
    "mark_near": {4},
    "gather_part": {4},
    "find_shortest_paths": {4},
    "walk_stretches": {1},
    "jacobians": {0},
    "pulls": {5},
    "dirichlet_sweep": {0},
    "at_own_tensors": {0},
    "clip_moduli": {0},
    "assemble": {0},
    "boundary_load": {0},
    "put_at": {2},
    "doubtful_pairs": {0, 3, 4},
    "find_pattern": {0, 1, 2},
    "wrong_pattern": {0},
    "divide_cells": {12},
    "find_cells": {3},
    "sure_hits": {3, 4},
    "find_places": {0},
    "remove_vertices": {0},
    "fill_rings": {0, 1, 2},
    "add_up": {9},
    "sure_signs": {1},
    "find_contact": {0},
}


@needs_extension
@pytest.mark.parametrize(("name", "make"), CASES)
def test_arrays_that_are_too_short_are_rejected(name, make):
    kernel, arguments = getattr(kernels.extension, name), make(np.random.default_rng(0))
    for i, each in enumerate(arguments):
        if isinstance(each, np.ndarray) and each.size and i not in _ANY_LENGTH.get(name, ()):
            with pytest.raises(ValueError, match=f"kernel {name} do not fit"):
                kernel(*arguments[:i], np.ascontiguousarray(each[..., :-1]), *arguments[i + 1 :])


def off_beat(array, *, strides):
    """Return the same numbers without alignment: in a buffer from its second byte on, or in a table of records."""
    if strides:
        table = np.zeros(array.shape[:1], dtype=[("numbers", array.dtype, array.shape[1:]), ("rest", np.float64)])
        table["numbers"] = array
        return table["numbers"]
    buffer = bytearray(array.nbytes + 1)
    given = np.frombuffer(buffer, dtype=array.dtype, offset=1).reshape(array.shape)
    given[...] = array
    return given


@needs_extension
def test_unaligned_arrays_are_rejected():
    F, label = np.array([[0, 1], [1, 2]]), np.empty(3, dtype=np.int64)
    with pytest.raises(TypeError, match=r"link_nodes.*not aligned"):
        kernels.extension.link_nodes(off_beat(F, strides=False), F, label)
    p, q, area = np.empty(2, dtype=complex), np.empty(2, dtype=complex), np.empty(2)
    gamma = off_beat(np.ones((2, 2), dtype=complex)[:, :1], strides=True).T
    assert gamma.strides[1] % gamma.itemsize
    with pytest.raises(TypeError, match=r"wirtinger.*parts of items"):
        kernels.extension.wirtinger(np.zeros(3, dtype=complex), np.array([[0, 1, 2]] * 2), gamma, p, q, area)


@needs_extension
def test_a_curve_through_a_missing_vertex_is_rejected():
    places, starts, pairs = np.zeros((3, 2)), np.array([0, 3]), np.zeros((9, 2), dtype=np.int64)
    for wrong in (-1, 3):
        with pytest.raises(ValueError, match="doubtful_pairs do not fit"):
            kernels.extension.doubtful_pairs(places, np.array([0, 1, wrong]), np.array([1, 2, 0]), starts, pairs)


@pytest.mark.parametrize("strides", [False, True])
def test_unaligned_triangles_are_accepted(strides):
    V, F = disk(3)
    given = off_beat(F, strides=strides)
    assert not given.flags.c_contiguous if strides else not given.flags.aligned
    assert np.array_equal(boundary_loops(given, len(V))[0], boundary_loops(F, len(V))[0])
    assert np.array_equal(components(given, len(V)), components(F, len(V)))
    assert certify(given, V[:, :2]).bijective


V, F = disk(3)
ENERGY, W = DeformationEnergy(V, F, ARAP()), V[:, 0] + 1j * V[:, 1]
BEYOND = np.where(F == 0, len(V), F)


@pytest.mark.parametrize(
    "call",
    [
        lambda: ReferenceMesh(V, BEYOND, "equilateral"),
        lambda: ReferenceMesh(V, -F, "rest"),
        lambda: ReferenceMesh(V, F, "equilateral").derivatives(W[1:]),
        lambda: Laplacian(BEYOND, len(V), np.arange(4)),
        lambda: Laplacian(F, len(V), np.arange(4)).factor(np.ones((3, len(F) - 1))),
        lambda: Laplacian(F, len(V), np.arange(4)).factor(np.full((3, len(F)), -1.0)).extend(W[1:]),
        lambda: DeformationEnergy(V, BEYOND, ARAP()),
        lambda: DeformationEnergy(V, -F, ARAP(), rest_F=F),
        lambda: ENERGY.value(W[:-1]),
        lambda: ENERGY.gradient_of(ENERGY.deform(W), len(V) - 1),
        lambda: ENERGY.steps_to_collapse(W[:-1], W[:-1]),
        lambda: ENERGY.steps_to_collapse(W, W[:-1]),
        lambda: certify(F, V, loops=[[0, 1, len(V)]]),
    ],
)
def test_kernels_do_not_get_missing_vertices(call):
    """Public functions check indices."""
    with pytest.raises(ValueError, match=r"refers? to ver|shape"):
        call()


def test_an_outdated_extension_is_reported(monkeypatch):
    def newer():
        pass

    monkeypatch.setattr(kernels, "extension", SimpleNamespace(__file__="there"))
    monkeypatch.setattr(kernels, "TWINS", {})
    with pytest.raises(ImportError, match=r"there is too old: it has no newer.*pip install"):
        kernels.compiled(newer)


@pytest.mark.parametrize(("value", "switched"), [("1", True), ("", False), ("0", False)])
def test_the_environment_switches_kernels_off(value, switched):
    code = "from quasiharmonic.util import kernels; print(kernels.extension is None)"
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"QUASIHARMONIC_PURE": value},
                          capture_output=True, text=True, check=True)  # fmt: skip
    assert (done.stdout.strip() == "True") >= switched


@needs_extension
@pytest.mark.skipif(sys.platform == "win32", reason="symbols are hidden there by default")
def test_the_extension_exports_its_entry_point_alone():
    library = ctypes.CDLL(kernels.extension.__file__)
    assert hasattr(library, "PyInit__compiled")
    assert not [name for name in ("take", "fit", "done", "sort_edges") if hasattr(library, name)]


@pytest.mark.skipif(kernels.extension is None, reason="there is no extension")
def test_shared_constants_have_the_values_of_the_python_source():
    expected = shared_constants(Path(quasiharmonic.__path__[0]))
    scalars = {name: value for name, value in expected.items() if not isinstance(value, tuple)}
    assert kernels.extension.constants == scalars
    assert scalars["TANH_BOUND"] == TANH.bound
    assert "INWARDS" in expected
