"""Ctrl-C during functions of maps with several islands: islands that were not reached keep their map."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from quasiharmonic import atlas, io
from quasiharmonic.io.seamed_mesh import SeamedMesh
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main, process
from shared.meshes import lift


def four_islands():
    """Curved disks of different sizes with injective maps, side by side."""
    V, F, uv = [], [], []
    for k, size in enumerate((4, 6, 5, 7)):
        flat, triangles = disk(size)
        F.append(triangles + sum(map(len, V)))
        V.append(lift(flat) + np.array([3 * k, 0, 0]))
        uv.append(flat * (1 + 0.3 * flat[:, :1]) + [3 * k, 0])
    return SeamedMesh(np.concatenate(V), np.concatenate(F), uv=np.concatenate(uv))


def interrupting(count):
    """A callback that raises KeyboardInterrupt at its call of this number."""
    calls = itertools.count()

    def callback(step):
        if next(calls) == count:
            raise KeyboardInterrupt

    return callback


FUNCTIONS = {
    "flatten": lambda mesh, callback: atlas.flatten(mesh, callback=callback),
    "flatten from the map": lambda mesh, callback: atlas.flatten(mesh, start=True, callback=callback),
    "flatten to the square": lambda mesh, callback: atlas.flatten(mesh, unit_square=True, callback=callback),
    "polish": lambda mesh, callback: atlas.polish(mesh, callback=callback),
    "polish freely": lambda mesh, callback: atlas.polish(mesh, free=True, callback=callback),
    "harmonise": lambda mesh, callback: atlas.harmonise(mesh, callback=callback),
    "injective_map": lambda mesh, callback: atlas.injective_map(mesh, callback=callback),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_islands_that_were_not_reached_keep_their_map(name):
    mesh = four_islands()
    before = [island.uv for island in mesh.islands]
    reached = set()
    for count in (0, 1, 3, 6, 10, 15, 21, 28, 40, 60, 100, 200, 400):
        try:
            found = FUNCTIONS[name](mesh, interrupting(count))
        except KeyboardInterrupt:
            continue
        reached.add(len(found.islands))
        assert atlas.certify(found.mesh).injective
        assert len(found.mesh.uv) == len(mesh.uv)
        for old, new in list(zip(before, found.mesh.islands, strict=True))[len(found.islands) :]:
            np.testing.assert_array_equal(new.uv, old)
    assert len(reached) > 1


def test_positions_are_needed_for_every_island():
    mesh = four_islands()
    with pytest.raises(ValueError, match="4 islands, not 3"):
        mesh.with_places([island.uv for island in mesh.islands[:3]])


@pytest.mark.slow
@pytest.mark.parametrize("command", ["flatten", "polish", "harmonise"])
def test_the_command_writes_an_injective_map(tmp_path, monkeypatch, capsys, command):
    mesh = four_islands()
    io.write_mapped(tmp_path / "in.obj", io.MeshData(mesh.V, mesh.F).with_places(mesh))
    for count in (5, 12):
        call = interrupting(count)
        monkeypatch.setattr(process, "progress_line", lambda *_, call=call: Shown(call))
        status = main([command, str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj")])
        said = capsys.readouterr()
        if status == 2:
            assert "nothing was written" in said.err
            continue
        assert status == 0
        assert main(["check", str(tmp_path / "out.obj")]) == 0
        capsys.readouterr()


class Shown:
    """In place of a line of progress: calls a function."""

    def __init__(self, call):
        self._call = call

    def __enter__(self):
        return self._call

    def __exit__(self, *_):
        pass
