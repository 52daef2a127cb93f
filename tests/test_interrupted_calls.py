"""Ctrl-C at an inconvenient moment of a call: the result is the best map so far, and nothing that was found is lost."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from quasiharmonic import Problem, Status, boundary_loops, solve
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.stages import CoarseToFine
from quasiharmonic.surfaces import disk

SEARCH = "quasiharmonic.solver.search.search"


def stop_at(iteration):
    """A callback that interrupts at this step and after."""

    def stop(step):
        if step.iteration >= iteration:
            raise KeyboardInterrupt

    return Mock(side_effect=stop)


def twisted(rings=8):
    """A disk onto an ellipse, and the positions of its boundary."""
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    return Problem(V, F, loop, V[loop] * [2, 1])


@pytest.mark.parametrize("refine", [False, True])
def test_before_the_first_stage(monkeypatch, refine):
    monkeypatch.setattr(f"{SEARCH}.coarse_mesh", Mock(side_effect=KeyboardInterrupt))
    result = solve(twisted(), strategy=[CoarseToFine(VectorAdam())], refine=refine)
    assert result.status is Status.INTERRUPTED
    assert result.stages == []
