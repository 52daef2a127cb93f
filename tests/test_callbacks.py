"""Step callbacks: the functions that accept one reject an object that is not callable at once."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import (
    Problem,
    batch,
    boundary_loops,
    flatten,
    harmonise,
    injective_map,
    injective_maps,
    keep_distances,
    morph,
    polish,
    repair,
    solve,
)
from quasiharmonic.apps.flattening import flattening_run
from quasiharmonic.solver.search import search
from quasiharmonic.surfaces import disk

V, F = disk(3)
(LOOP,) = boundary_loops(F, len(V))
PLACES = V[LOOP] * (1.0, 0.5)
FLIPPED = V * np.where(np.arange(len(V)) == 1, -1.0, 1.0)[:, None]

TAKERS = {
    "injective_map": lambda callback: injective_map(V, F, LOOP, PLACES, callback=callback),
    "injective_maps": lambda callback: injective_maps([(V, F, LOOP, PLACES)], callback=callback),
    "solve": lambda callback: solve(Problem(V, F, LOOP, PLACES), callback=callback),
    "polish": lambda callback: polish(V, F, V, fixed=LOOP, callback=callback),
    "harmonise": lambda callback: harmonise(V, F, V, fixed=LOOP, callback=callback),
    "flatten": lambda callback: flatten(V, F, callback=callback),
    "flatten with pins": lambda callback: flatten(V, F, fixed=[0], target=[(0, 0)], callback=callback),
    "keep_distances": lambda callback: keep_distances(V, F, V, callback=callback),
    "morph": lambda callback: morph(V, F, LOOP, PLACES, callback=callback),
    "repair": lambda callback: repair(V, F, FLIPPED, callback=callback),
    "batch": lambda callback: batch.run("set", "out", callback=callback),
}


@pytest.mark.parametrize("take", TAKERS.values(), ids=TAKERS)
def test_objects_that_are_not_callable_are_rejected_first(take, monkeypatch):
    def computed(*arguments, **options):
        raise AssertionError("the search has begun")

    monkeypatch.setattr(search.Search, "run", computed, raising=False)
    monkeypatch.setattr(flattening_run.Flattening, "run", computed)
    with pytest.raises(ValueError, match="callback must be callable, or None, not 3"):
        take(3)
