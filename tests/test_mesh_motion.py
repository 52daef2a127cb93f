"""``benchmarks/mesh_motion.py`` on small meshes."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import certify

pytest.importorskip("skfem", reason="scikit-fem is not installed: pip install '.[bench]'")

import mesh_motion
import moving_scenes


@pytest.fixture(scope="module")
def hole():
    return moving_scenes.travelling_hole(step=0.2, laps=0.5)


def test_every_method_moves_a_hole_as_far_as_it_can(hole, tmp_path):
    runs, yardstick = mesh_motion.race(hole, steps=12)
    assert yardstick
    assert all(run.steps >= 2 for run in runs.values())
    assert runs[mesh_motion.OURS, "last"].steps == 12
    assert runs[mesh_motion.MORPH, "first"].at == [8]
    # There are no jumps.
    assert all(1 <= move < 5 for move in runs[mesh_motion.OURS, "last"].moves)
    shape = np.array(runs[mesh_motion.OURS, "last"].quality)
    assert np.all((shape > 0) & (shape <= 1))
    (row, *_) = mesh_motion.rows("travelling hole", hole, runs, yardstick)
    assert row["method"] == "harmonic"
    assert "| **0.5** |" in mesh_motion.table(
        [{**row, "steps": hole.steps, "valid to": 0.5}], {"travelling hole": hole}
    )
    mesh_motion.draw({"travelling hole": runs}, {"travelling hole": hole}, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 0


def test_similarity_is_one_for_a_similarity_transformation(hole):
    turned = hole.V @ [[0, 2], [-2, 0]]
    np.testing.assert_allclose(mesh_motion.likeness(hole, turned), 1)
    stretched = mesh_motion.likeness(hole, hole.V * [2, 1])
    np.testing.assert_allclose(stretched, 2 * 2 / (2**2 + 1))


def test_limit_of_rotation_from_edges():
    """A ring of one layer of triangles: a single edge limits its rotation."""
    scene = moving_scenes.turning_disk(step=0.4)
    assert certify(scene.F, scene.V).bijective
    assert 100 < mesh_motion.forbidden_beyond(scene) < 600
