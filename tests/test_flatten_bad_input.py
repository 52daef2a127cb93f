"""Surfaces that cannot be flattened, or only just: `flatten` and ``qhm flatten`` give the same result."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from quasiharmonic import certify, flatten, io
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main

FLAT, F = disk(5)
V = np.column_stack([FLAT, np.zeros(len(FLAT))])


def octahedron():
    V = np.concatenate([np.eye(3), -np.eye(3)])
    x, y, z, a, b, c = range(6)
    return V, np.array([(x, y, z), (y, a, z), (a, b, z), (b, x, z), (y, x, c), (a, y, c), (b, a, c), (x, b, c)])


def torus(n=8):
    """A mesh without its last two triangles, so that it has a boundary."""
    i, j = np.divmod(np.arange(n * n), n)
    at = 2 * np.pi / n
    V = np.stack([np.cos(at * i), np.sin(at * i), 0 * i]).T * (2 + np.cos(at * j))[:, None]
    V[:, 2] = np.sin(at * j)

    def number(i, j):
        return i % n * n + j % n

    lower = np.stack([number(i, j), number(i + 1, j), number(i + 1, j + 1)], axis=1)
    upper = np.stack([number(i, j), number(i + 1, j + 1), number(i, j + 1)], axis=1)
    return V, np.stack([lower, upper], axis=1).reshape(-1, 3)[:-2]


def annulus_of_twenty():
    z = np.exp(2j * np.pi * np.arange(10) / 10)
    ring = np.stack([z.real, z.imag, 0 * z.real], axis=1)
    i, j = np.arange(10), np.roll(np.arange(10), -1)
    triangles = np.concatenate([np.stack([i, j, j + 10], axis=1), np.stack([i, j + 10, i + 10], axis=1)])
    return np.concatenate([ring, 0.5 * ring + (0, 0, 0.3)]), triangles


def with_a_flat_triangle():
    bad = V.copy()
    bad[F[7, 0]] = bad[F[7, 1]]
    return bad, F


REFUSED = {
    "closed": (octahedron(), "the surface is closed: it has no boundary; cut it open first"),
    "a handle": (torus(), "the surface has 1 handle and cannot be flattened: cut it open first"),
    "no area": (with_a_flat_triangle(), "triangles 7, 43 of zero area in the rest mesh: distortion is undefined there"),
}


def command(tmp_path, V, F, fixed=(), target=(), options=()):
    """Return the exit status of ``qhm flatten``, its report, and its map if it wrote one."""
    mesh = io.MeshData(V, F)
    call = ["flatten", tmp_path / "in.obj", "-o", tmp_path / "out.obj", "--json", tmp_path / "report.json", *options]
    if len(fixed):
        places = np.zeros((len(V), 2))
        places[fixed] = target
        mesh = mesh.with_map(places)
        (tmp_path / "fixed.txt").write_text("".join(f"{v}\n" for v in fixed))
        call += ["--fixed", tmp_path / "fixed.txt"]
    io.write_obj(tmp_path / "in.obj", mesh)
    status = main([str(word) for word in call])
    if not (tmp_path / "out.obj").exists():
        return status, None, None
    return status, json.loads((tmp_path / "report.json").read_text()), io.map_of(io.read_mesh(tmp_path / "out.obj"))


@pytest.mark.parametrize(("mesh", "message"), REFUSED.values(), ids=REFUSED)
@pytest.mark.parametrize(("fixed", "target"), [((), ()), ((2, 3), ((0.0, 0.0), (1.0, 0.0)))], ids=["free", "pinned"])
def test_rejected_surfaces_are_named(mesh, message, fixed, target, tmp_path, capsys):
    given = {"fixed": fixed, "target": target} if fixed else {}
    with pytest.raises(ValueError, match=message):
        flatten(*mesh, **given)
    assert command(tmp_path, *mesh, list(fixed), target) == (2, None, None)
    assert re.search(message, capsys.readouterr().err)


IMPOSSIBLE = {
    "wound wrongly": (F[5], [(0.0, 0), (0, 1), (1, 0)], "inverted_triangle", "All vertices of triangle 5 are fixed"),
    "in a row": (F[5], [(0.0, 0), (1, 1), (2, 2)], "inverted_triangle", "their targets flatten it"),
    "two in one place": ([3, 40], [(0.5, 0.5), (0.5, 0.5)], "pin", "Vertices 3, 40 are fixed at the same position"),
}


@pytest.mark.parametrize(("fixed", "target", "kind", "message"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_impossible_problems_are_reported_with_the_best_map(fixed, target, kind, message, tmp_path, capsys):
    result = flatten(V, F, fixed=fixed, target=target)
    assert result.status.name == "IMPOSSIBLE"
    assert not result.certificate.bijective
    assert message in result.diagnosis.summary()
    np.testing.assert_array_equal(result.uv[fixed], target)
    status, report, uv = command(tmp_path, V, F, fixed, target)
    assert status == 1
    assert report["status"] == "impossible"
    assert report["mean_energy"] is None
    assert kind in {found["kind"] for found in report["diagnosis"]["obstructions"]}
    assert message in capsys.readouterr().out
    np.testing.assert_array_equal(uv[fixed], target)


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e150, 1e300])
@pytest.mark.parametrize("pinned", [False, True])
def test_any_size_is_flattened(scale, pinned, tmp_path):
    fixed, target = ([1, 50], np.array([(0.0, 0.0), (1.0, 0.0)]) * scale) if pinned else ([], np.zeros((0, 2)))
    given = {"fixed": fixed, "target": target} if pinned else {}
    result = flatten(V * scale, F, **given)
    assert result.status.name == "POLISHED"
    assert certify(F, result.uv).bijective
    assert result.history[-1].energy < 1e-2
    status, report, uv = command(tmp_path, V * scale, F, fixed, target)
    assert status == 0
    assert report["bijective"]
    np.testing.assert_array_equal(uv, result.uv)


@pytest.mark.slow
@pytest.mark.parametrize("apart", [1e-150, 1e150])
def test_pins_of_any_size_are_reached(apart, tmp_path):
    fixed, target = [1, 50], np.array([(0.0, 0.0), (apart, 0.0)])
    result = flatten(V, F, fixed=fixed, target=target)
    assert result.certificate.bijective
    assert np.isfinite(result.history[-1].energy)
    status, report, uv = command(tmp_path, V, F, fixed, target)
    assert status == 0
    assert report["mean_energy"] == result.history[-1].energy
    np.testing.assert_array_equal(uv[fixed], target)


@pytest.mark.parametrize("options", [{}, {"energy": "mips"}, {"energy": "distances"}, {"max_iterations": 0}])
def test_an_annulus_of_twenty_triangles(options, tmp_path):
    V, F = annulus_of_twenty()
    assert len(F) == 20
    result = flatten(V, F, **options)
    assert result.certificate.bijective
    assert len(result.certificate.loops) == 2
    assert result.status.name == ("STILL_FALLING" if options.get("max_iterations") == 0 else "POLISHED")
    words = [word for name, value in options.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    status, report, uv = command(tmp_path, V, F, options=words)
    assert status == 0
    assert report["status"] == result.status.name.lower()
    np.testing.assert_array_equal(uv, result.uv)


@pytest.mark.slow
def test_pins_on_an_annulus_of_twenty_triangles(tmp_path):
    V, F = annulus_of_twenty()
    fixed, target = [0, 5, 10], [(0.0, 0.0), (2.0, 0.0), (0.5, 0.5)]
    result = flatten(V, F, fixed=fixed, target=target)
    assert result.certificate.bijective
    np.testing.assert_array_equal(result.uv[fixed], target)
    status, report, uv = command(tmp_path, V, F, fixed, target)
    assert status == 0
    assert report["status"] == "polished"
    np.testing.assert_array_equal(uv[fixed], target)


def test_negative_numbers_of_steps_are_rejected(tmp_path):
    with pytest.raises(SystemExit):
        command(tmp_path, V, F, options=["--max-iterations", "-1"])
