"""All results and all certificates have the same attributes, with the same meaning."""

from __future__ import annotations

import copy
import json
import pickle
from enum import Enum

import numpy as np
import pytest

import quasiharmonic as qh
from quasiharmonic import Problem, atlas, results
from quasiharmonic.surfaces import disk, grid, starfish
from quasiharmonic.util.outcome import Outcome, Verdict


def make_map():
    V, F = disk(4)
    (loop,) = qh.boundary_loops(F, len(V))
    return qh.injective_map(V, F, loop, V[loop] * [2, 1], polish="mips")


def make_atlas():
    V, F = disk(4)
    return atlas.polish(atlas.SeamedMesh(V, F, F, V * [2, 1]))


def make_animation():
    V, F = disk(4)
    (loop,) = qh.boundary_loops(F, len(V))
    return qh.animate(Problem(V, F, loop, V[loop]), [V[loop], V[loop] * [1.2, 1]], polish="mips")


def make_morph():
    points, F = grid(6, 6)
    upper = np.flatnonzero(points[:, 1] == 1)
    return qh.morph(points, F, upper, points[upper] + [0, 0.2])


def make_repair():
    V, F = disk(4)
    uv = V.copy()
    uv[0] += 5
    return qh.repair(V, F, uv)


def make_tetrahedra():
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2, 0.2, 0.2]])
    T = [[0, 1, 2, 4], [0, 1, 3, 4], [0, 2, 3, 4], [1, 2, 3, 4]]
    return qh.injective_tetrahedra(X, T, range(4), 2.0 * X[:4] + 1.0)


def make_field(*shape):
    field = np.zeros((*shape, len(shape)))
    field[tuple(size // 2 for size in shape)] = 1.6
    return qh.nearest_invertible(field)


def make_warp():
    return qh.warp_by_landmarks(np.zeros((20, 20)), [[10, 10]], [[12, 10]], resolution=8)


def make_unwrap():
    return qh.unwrap(*starfish(3, 12))


def make_scene():
    return qh.unwrap([disk(4), disk(6)], resolution=64)


MAKERS = {
    "MapResult": make_map,
    "MappedAtlas": make_atlas,
    "Animation": make_animation,
    "MorphResult": make_morph,
    "RepairResult": make_repair,
    "TetrahedraResult": make_tetrahedra,
    "InvertibleField": lambda: make_field(9, 9),
    "InvertibleVolume": lambda: make_field(5, 5, 5),
    "WarpResult": make_warp,
    "UnwrapResult": make_unwrap,
    "SceneResult": make_scene,
}
NAMES = {"success", "status", "message", "n_iterations", "seconds", "certificate"}


@pytest.fixture(scope="module", params=MAKERS)
def made(request):
    found = MAKERS[request.param]()
    assert type(found).__name__ == request.param
    return found


def test_every_result_that_is_listed_is_of_the_family():
    listed = {name for name in results.__all__ if issubclass(getattr(results, name), Outcome)}
    assert listed == set(MAKERS)


def test_a_refined_problem_is_no_map():
    V, F = disk(4)
    (loop,) = qh.boundary_loops(F, len(V))
    refined = qh.refine_problem(Problem(V, F, loop, V[loop]))
    assert refined
    assert refined.success
    assert repr(refined) == f"<RefinedProblem: {refined.message.splitlines()[0]}>"
    assert not any(hasattr(refined, name) for name in ("status", "certificate", "n_iterations", "to_dict"))


def test_results_share_their_attributes(made):
    assert isinstance(made, Outcome)
    assert made.success is bool(made) is True
    assert isinstance(made.status, Enum)
    assert made.message
    assert made.n_iterations >= 0
    assert 0 < made.seconds < 600
    assert made.summary()


def test_the_report_has_what_all_results_share(made):
    report = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    # An atlas of one island reports as its island does.
    assert report.keys() >= NAMES
    assert report["success"] is True
    assert report["status"] == made.status.name.lower()
    assert report["n_iterations"] == made.n_iterations
    assert report["certificate"]["valid"] is made.certificate.valid
    assert report["certificate"]["bijective"] is made.certificate.bijective


def test_results_can_be_pickled(made):
    again = pickle.loads(pickle.dumps(made))
    assert again.to_dict() == made.to_dict()
    assert again.summary() == made.summary()


def test_results_are_compared_by_identity(made):
    assert made in {made}
    assert made != copy.copy(made)


def test_recorded_maps_are_compared_by_identity():
    first, second = (qh.flatten(*disk(4), record_every=1).path for _ in range(2))
    assert first[0] in first
    assert len({*first, *second}) == len(first) + len(second)


def test_the_drift_of_a_pickled_morph_is_the_same():
    morphed = make_morph()
    assert pickle.loads(pickle.dumps(morphed)).drift() == morphed.drift()


def test_certificates_share_their_attributes(made):
    verdict = made.certificate
    assert isinstance(verdict, Verdict)
    assert verdict.valid is True
    assert verdict.bijective is True
    assert verdict.summary()
    assert json.dumps(verdict.to_dict(), allow_nan=False)
    assert repr(verdict).startswith(f"<{type(verdict).__name__}")


def test_a_failure_is_a_failure_everywhere():
    V, F = disk(4)
    (loop,) = qh.boundary_loops(F, len(V))
    found = qh.injective_map(V, F, loop, V[loop][::-1])
    assert not found
    assert found.certificate.valid is found.certificate.injective is False
    assert not results.AtlasVerdict((), np.empty((0, 2), dtype=np.int64)).valid


def test_an_animation_without_frames_is_certified_as_nothing():
    empty = results.Animation([], np.empty((0, 3, 2)), np.zeros(0, dtype=bool), np.zeros(0), interrupted=True)
    assert not empty
    assert not empty.certificate.valid
    assert not empty.certificate.bijective
    assert empty.to_dict()["statuses"] == []


def test_the_frames_of_an_animation_have_a_status_each():
    animation = make_animation()
    assert animation.to_dict()["statuses"] == [frame.status.name.lower() for frame in animation]


def test_a_repair_counts_its_iterations():
    repaired = make_repair()
    assert repaired.n_iterations == sum(island.n_iterations for island in repaired.islands) > 0
    V, F = disk(4)
    assert qh.repair(V, F, V).n_iterations == 0
