"""Several surfaces, some with pins: pinned parts go to their pins, others next to them, and none overlap."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import Status, boundary_loops, certify, flatten
from quasiharmonic.io import MeshData, map_of, read_mesh, write_obj
from quasiharmonic.results import Forbids, Kind
from quasiharmonic.surfaces import annulus, disk
from quasiharmonic.ui.cli import main


def several(*surfaces):
    """Return planar surfaces as one mesh, and the first vertex of each."""
    firsts = np.cumsum([0, *(len(V) for V, _ in surfaces)])
    V = np.concatenate([V for V, _ in surfaces])
    return V, np.concatenate([F + first for (_, F), first in zip(surfaces, firsts, strict=False)]), firsts[:-1]


def solved(V, F, fixed, target, **options):
    result = flatten(V, F, fixed=fixed, target=target, **options)
    np.testing.assert_array_equal(result.uv[fixed], np.asarray(target, dtype=np.float64))
    assert certify(F, result.uv).bijective
    assert result.certificate.bijective
    assert result.status in {Status.POLISHED, Status.EXHAUSTED}
    return result


def lengths(F, uv):
    return np.linalg.norm(uv[F] - uv[np.roll(F, -1, axis=1)], axis=2)


def test_each_part_goes_to_its_pins():
    V, F, (_, second) = several(disk(6), disk(4))
    result = solved(V, F, [3, 40, second + 3], [V[3], V[40], (4.0, 1.0)])
    # There are no obstacles, so both parts keep their shape.
    np.testing.assert_allclose(lengths(F, result.uv), lengths(F, V), atol=1e-6)
    np.testing.assert_allclose(result.uv[:second], V[:second], atol=1e-6)


@pytest.mark.slow
def test_parts_without_pins_are_placed_next_to_the_others():
    V, F, (_, second, third) = several(disk(6), disk(5), disk(3))
    result = solved(V, F, [second + 3, third + 3], [(10.0, 20.0), (10.2, 20.0)], gap=0.5)
    held, free = result.uv[second:], result.uv[:second]
    np.testing.assert_allclose(lengths(F[F.max(axis=1) < second], result.uv), lengths(F, V)[: 6 * 36], atol=1e-6)
    assert free[:, 0].min() >= held[:, 0].max() + 0.5
    assert free[:, 1].min() == pytest.approx(held[:, 1].min())


@pytest.mark.slow
def test_overlapping_parts_move_apart():
    V, F, (_, second) = several(disk(5), disk(5))
    fixed = [3, 50, second + 3, second + 50]
    result = solved(V, F, fixed, [(0.0, 0), (1, 0), (0.5, 0.1), (0.7, 0.8)])
    again = solved(V, F, fixed, [(0.0, 0), (1, 0), (0.5, 0.1), (0.7, 0.8)])
    np.testing.assert_array_equal(result.uv, again.uv)
    # Alone, each of them would cover pins of the other.
    where = [(0, 0), (1, 0)], [(0.5, 0.1), (0.7, 0.8)]
    alone = [flatten(*disk(5), fixed=[3, 50], target=places).uv for places in where]
    assert not certify(F, np.concatenate(alone)).bijective


@pytest.mark.slow
def test_one_part_is_placed_in_the_hole_of_another():
    ring, tile = annulus(6), disk(5)
    V, F, (_, second) = several(ring, tile)
    inner = min(boundary_loops(ring[1], second), key=len)
    result = solved(V, F, [*inner, second + 3], [*V[inner], V[inner].mean(axis=0)])
    # The tile shrinks to fit inside, although alone it would cover the whole ring.
    assert np.abs(result.uv[second:]).max() < np.abs(V[inner]).max()


@pytest.mark.slow
def test_three_parts_at_one_location():
    V, F, (_, second, third) = several(disk(4), disk(4), disk(4))
    solved(V, F, [3, second + 3, third + 3], [(10.0, 10), (10.2, 10), (10.1, 10.1)], energy="mips")


@pytest.mark.slow
def test_the_reason_for_impossibility_uses_the_numbers_of_the_mesh():
    V, F, (_, second) = several(disk(4), disk(4))
    result = flatten(V, F, fixed=[3, second + 3], target=np.zeros((2, 2)))
    assert result.status is Status.IMPOSSIBLE
    (shared,) = result.diagnosis.obstructions
    assert shared.vertices.tolist() == [3, second + 3]
    pair = F[50, :2]
    result = flatten(V, F, fixed=[*pair, *(pair + second)], target=[(0.0, 0), (1, 1), (1, 0), (0, 1)])
    (crossing,) = result.diagnosis.obstructions
    assert crossing.forbids is Forbids.BIJECTIVE
    assert {frozenset(edge) for edge in crossing.edges.tolist()} == {frozenset(pair), frozenset(pair + second)}
    # Only the search on one part finds it: a boundary fixed with the wrong orientation.
    loop = boundary_loops(F[len(F) // 2 :] - second, second)[0] + second
    result = flatten(V, F, fixed=[3, *loop], target=[(9.0, 9), *(V[loop] * (1, -1))])
    assert result.status is Status.IMPOSSIBLE
    (patch,) = result.diagnosis.obstructions
    assert patch.kind is Kind.INVERTED_PATCH
    assert f"the piece around vertex {second}, with its own numbering" in patch.message
    assert (patch.triangles >= len(F) // 2).all()
    assert not result.certificate.injective


def test_pins_that_doubles_do_not_distinguish_are_reported():
    V, F, (_, second) = several(disk(4), disk(4))
    result = flatten(V, F, fixed=[3, 20], target=[(1e150, 0.0), (2e150, 0.0)])
    assert result.status is Status.ROUNDED
    assert not result.certificate.injective
    assert certify(F[: len(F) // 2], result.uv[:second]).bijective


@pytest.mark.parametrize("at", [1, 3, 12])
def test_ctrl_c_leaves_every_pin_at_its_target_position(at):
    V, F, (_, second, _) = several(disk(5), disk(5), disk(3))
    seen = []

    def callback(step):
        seen.append(step)
        if len(seen) == at:
            raise KeyboardInterrupt

    fixed, target = [3, 50, second + 3], [(0.0, 0), (2, 0), (1, 0)]
    result = flatten(V, F, fixed=fixed, target=target, callback=callback)
    assert result.status is Status.INTERRUPTED
    assert len(seen) == at
    np.testing.assert_array_equal(result.uv[fixed], target)


@pytest.mark.slow
def test_the_command_accepts_several_parts(tmp_path, capsys):
    V, F, (_, second) = several(disk(4), disk(4))
    write_obj(tmp_path / "in.obj", MeshData(np.column_stack([V, 0 * V[:, 0]]), F).with_map(V + 7))
    (tmp_path / "pins.txt").write_text(f"3\n{second + 9}\n")
    call = ["flatten", str(tmp_path / "in.obj"), "--fixed", str(tmp_path / "pins.txt"), "-o", str(tmp_path / "out.obj")]
    assert main(call) == 0
    # Both pins are one grid step of the disk apart, so the two parts must move apart.
    assert "the distortion has converged" in capsys.readouterr().out
    written = read_mesh(tmp_path / "out.obj")
    np.testing.assert_array_equal(map_of(written)[[3, second + 9]], (V + 7)[[3, second + 9]])
    assert certify(written.F, map_of(written)).bijective


@pytest.mark.slow
def test_the_messages_of_the_command_have_the_numbers_of_the_file(tmp_path, capsys, rng):
    V, F, (_, second) = several(disk(4), disk(4))
    number, order = rng.permutation(len(V)), rng.permutation(len(F))
    places, triangles = np.empty_like(V), number[F][order]
    places[number] = V
    mesh = MeshData(np.column_stack([places, 0 * places[:, 0]]), triangles)
    pins = number[[3, second + 9]]
    write_obj(tmp_path / "in.obj", mesh.with_map(np.full((len(V), 2), 0.5)))
    (tmp_path / "pins.txt").write_text("".join(f"{v}\n" for v in pins))
    call = ["flatten", str(tmp_path / "in.obj"), "--fixed", str(tmp_path / "pins.txt"), "-o", str(tmp_path / "out.obj")]
    assert main(call) == 1
    assert f"Vertices {pins.min()}, {pins.max()} are fixed at the same position" in capsys.readouterr().out
    # There is space for both, so all triangles keep their shape from the file.
    write_obj(tmp_path / "in.obj", mesh.with_map(places + 7))
    assert main(call) == 0
    written = read_mesh(tmp_path / "out.obj")
    np.testing.assert_array_equal(written.F, triangles)
    assert certify(triangles, map_of(written)).bijective
