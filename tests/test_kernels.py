"""Every kernel in C does what its text in NumPy does, and refuses what it was not written for."""

from __future__ import annotations

import os
import pkgutil
import subprocess
import sys
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

import quasiharmonic
from quasiharmonic import kernels
from shared.kernels import ARGUMENTS

# Rooms that need what not everybody has installed, and that have no kernels.
_WITHOUT = "torch", "jax", "notebook", "studio", "batch", "report"
for module in pkgutil.walk_packages(quasiharmonic.__path__, "quasiharmonic."):
    if module.name.split(".")[1] not in (*_WITHOUT, "__main__"):
        import_module(module.name)

needs_extension = pytest.mark.skipif(kernels.extension is None, reason="the extension is not built, or switched off")
CASES = [pytest.param(name, make, id=f"{name}-{i}") for name, some in ARGUMENTS.items() for i, make in enumerate(some)]


def outcome(kernel, arguments):
    """What a kernel makes of its arguments, and its answer; the arrays are copies, laid out as they were."""
    given = [each.copy() if isinstance(each, np.ndarray) and each.flags.writeable else each for each in arguments]
    return [*given, kernel(*given)]


def same(one, other):
    """Arrays of integers alike, of floats but for rounding where they are not tiny beside their neighbours."""
    if isinstance(one, np.ndarray) and one.dtype.kind in "fc":
        scale = np.abs(one[np.isfinite(one)]).max(initial=0)
        with np.errstate(all="ignore"):  # of infinities, by NumPy 1
            return np.allclose(one, other, rtol=1e-11, atol=1e-14 * scale, equal_nan=True)
    return one == pytest.approx(other, rel=1e-11) if isinstance(one, float) else np.array_equal(one, other)


def test_every_kernel_has_arguments_here():
    assert set(ARGUMENTS) == set(kernels.TWINS)


@needs_extension
def test_every_kernel_has_a_text_in_numpy():
    assert {name for name in dir(kernels.extension) if not name.startswith("_")} == set(kernels.TWINS)


@needs_extension
@pytest.mark.parametrize(("name", "make"), CASES)
def test_both_texts_say_the_same(name, make):
    for seed in range(3):
        arguments = make(np.random.default_rng(seed))
        with np.errstate(all="ignore"):
            expected = outcome(kernels.TWINS[name], arguments)
        got = outcome(getattr(kernels.extension, name), arguments)
        assert [same(one, other) for one, other in zip(expected, got, strict=True)] == [True] * len(got)


@needs_extension
@pytest.mark.parametrize(("name", "make"), CASES)
def test_other_arrays_are_refused(name, make):
    """Another type of any of them, one too few, one too many."""
    kernel, arguments = getattr(kernels.extension, name), make(np.random.default_rng(0))
    for i, each in enumerate(arguments):
        if isinstance(each, np.ndarray):
            with pytest.raises(TypeError, match=name):
                kernel(*arguments[:i], np.zeros(each.shape, dtype=np.float32), *arguments[i + 1 :])
    for wrong in (arguments[:-1], (*arguments, arguments[-1]), ()):
        with pytest.raises(TypeError, match=f"{name} was given {len(wrong)} arguments"):
            kernel(*wrong)


def test_an_extension_of_before_is_told(monkeypatch):
    def newer():
        pass

    monkeypatch.setattr(kernels, "extension", SimpleNamespace(__file__="there"))
    monkeypatch.setattr(kernels, "TWINS", {})
    with pytest.raises(ImportError, match=r"there is too old to have newer.*pip install"):
        kernels.compiled(newer)


@pytest.mark.parametrize(("value", "switched"), [("1", True), ("", False)])
def test_the_environment_switches_them_off(value, switched):
    code = "from quasiharmonic import kernels; print(kernels.extension is None)"
    done = subprocess.run([sys.executable, "-c", code], env=os.environ | {"QUASIHARMONIC_PURE": value},
                          capture_output=True, text=True, check=True)  # fmt: skip
    assert (done.stdout.strip() == "True") >= switched
