"""Tensors on the CPU in place of arrays: values are converted, gradients are not."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import boundary_loops, certify, distortion, flatten, injective_map
from quasiharmonic.surfaces import disk

V, F = disk(3)
(LOOP,) = boundary_loops(F, len(V))
BEAN = V[LOOP] * (1 + 0.3 * V[LOOP, :1])
MAP = injective_map(V, F, LOOP, BEAN)


def test_torch():
    torch = pytest.importorskip("torch")
    for tensor in (torch.from_numpy, torch.tensor):
        np.testing.assert_array_equal(injective_map(*map(tensor, (V, F, LOOP, BEAN))).uv, MAP.uv)
    assert certify(torch.tensor(F), torch.tensor(MAP.uv)).bijective
    with pytest.raises(
        ValueError, match=r"V is a Tensor that requires grad.*V\.detach\(\), or use quasiharmonic\.torch"
    ):
        flatten(torch.tensor(V, requires_grad=True), F)
    with pytest.raises(ValueError, match=r"uv is a Tensor on meta: pass uv\.cpu\(\)"):
        distortion(V, F, torch.empty(V.shape, device="meta"))


def test_jax():
    jax = pytest.importorskip("jax")
    assert injective_map(*map(jax.numpy.asarray, (V, F, LOOP, BEAN))).injective
    with pytest.raises(ValueError, match=r"V is a DynamicJaxprTracer that JAX traces.*quasiharmonic\.jax"):
        jax.jit(lambda V: distortion(V, F, MAP).sigma1)(jax.numpy.asarray(V))
