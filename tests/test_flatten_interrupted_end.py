"""Ctrl-C while `flatten` judges, places and certifies maps: the map that was found is returned."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import flatten
from quasiharmonic.apps.flattening import free_boundary
from quasiharmonic.apps.flattening.contacts import Rim
from quasiharmonic.apps.flattening.flattening_run import Flattening
from quasiharmonic.results import Status
from quasiharmonic.surfaces import grid


def roof(turns):
    """A strip wound around a cylinder with little pitch, whose isometric image overlaps itself after one turn."""
    V, F = grid(60, 3)
    angle, height = 2 * np.pi * turns * V[:, 0] / V[:, 0].max(), V[:, 1] / V[:, 1].max()
    return np.stack([(1 + 0.4 * height) * np.cos(angle), (1 + 0.4 * height) * np.sin(angle), 0.1 * angle], axis=1), F


def interrupt_once(monkeypatch, owner, name, call=1):
    """Let a function raise KeyboardInterrupt in its first or another call."""
    function, calls = getattr(owner, name), []

    def interrupted(*args, **kwargs):
        calls.append(name)
        if len(calls) == call:
            raise KeyboardInterrupt
        return function(*args, **kwargs)

    monkeypatch.setattr(owner, name, interrupted)
    return calls


@pytest.mark.parametrize("call", [1, 2])
def test_an_interrupt_during_the_last_certificates_repeats_them(call, monkeypatch):
    V, F = roof(0.5)
    whole = flatten(V, F)
    calls = interrupt_once(monkeypatch, free_boundary, "certify", call)
    result = flatten(V, F)
    assert len(calls) > call
    assert result.status is Status.INTERRUPTED
    assert np.array_equal(result.uv, whole.uv)
    assert result.certificate.bijective


def test_an_interrupt_while_overlaps_are_pulled_apart_keeps_a_bijective_map(monkeypatch):
    V, F = roof(1.3)
    assert flatten(V, F).certificate.bijective
    interrupt_once(monkeypatch, Rim, "pull_apart")
    result = flatten(V, F)
    assert result.status is Status.INTERRUPTED
    assert result.certificate.bijective


def test_pieces_after_an_interrupted_one_get_their_initial_maps(monkeypatch):
    V, F = roof(0.5)
    both = (
        np.concatenate([V, V + np.array([5, 0, 0]), V + np.array([0, 5, 0])]),
        np.concatenate([F, F + len(V), F + 2 * len(V)]),
    )
    interrupt_once(monkeypatch, Flattening, "run", 2)
    result = flatten(*both)
    assert result.status is Status.INTERRUPTED
    assert result.certificate.bijective
    assert result.summary().count("start") == 3


def test_a_second_interrupt_ends_the_call(monkeypatch):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(free_boundary, "certify", interrupted)
    with pytest.raises(KeyboardInterrupt):
        flatten(*roof(0.5))
