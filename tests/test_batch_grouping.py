"""Small problems of a data set solved in one batch: results equal those of separate runs, and no problem is lost."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from quasiharmonic import batch, io
from quasiharmonic.batch import ProblemFiles
from quasiharmonic.linsolve import available
from quasiharmonic.ui.batch import groups, supervisor, worker
from quasiharmonic.ui.batch.problems import GROUP_OF_FILES, SMALL_FILE, group_small
from quasiharmonic.ui.batch.settings import Orders
from shared.datasets import lasting, record_of, star_of, write_problem, write_stars

pytestmark = [
    pytest.mark.long,
    pytest.mark.usefixtures("quick_workers"),
    pytest.mark.skipif("qdldl" not in available(), reason="where there is no QDLDL, each problem is solved by itself"),
]


def jobs_of(source, out, **settings):
    """The jobs of all problems of a data set, as a process receives them."""
    orders = Orders(out, batch.Settings(**settings))
    return [
        {
            "mesh": str(files.mesh),
            "fixed": None if files.fixed is None else str(files.fixed),
            "folder": str(orders.folder(files)),
            "settings": orders.settings.to_dict(),
            "record": {"problem": files.name, "key": orders.settings.key(files)},
        }
        for files in batch.find_problems(source, plain=orders.settings.plain)
    ]


def solved_both_ways(source, tmp_path, **settings):
    """Solve all problems separately and batched; return the numbers of those that were batched."""
    told = []
    groups.solve_some(jobs_of(source, tmp_path / "together", **settings), told.append)
    for job in jobs_of(source, tmp_path / "alone", **settings):
        worker.solve_files(job, lambda message: None)
    return sorted(message["done"] for message in told)


def assert_as_alone(tmp_path, names):
    for name in names:
        one, other = (tmp_path / way / "results" / name / "map.obj" for way in ("together", "alone"))
        assert one.read_bytes() == other.read_bytes()
        record = record_of(tmp_path / "together", name)
        assert lasting(record) == lasting(record_of(tmp_path / "alone", name))
        assert set(record) == set(record_of(tmp_path / "alone", name))
        parts = [seconds for field, seconds in record.items() if field.startswith("seconds_")]
        assert 0 < sum(parts) <= record["seconds"] * (1 + 1e-12)


def test_maps_and_records_equal_those_of_separate_runs(tmp_path):
    """The results agree to the last bit, for meshes of different sizes and outlines."""
    names = [f"{k:02d}" for k in range(10)]
    for k, name in enumerate(names):
        write_problem(tmp_path / "set" / name, *star_of(3 + k, depth=0.7 - 0.02 * k, tips=3 + k % 4))
    assert solved_both_ways(tmp_path / "set", tmp_path) == list(range(10))
    assert_as_alone(tmp_path, names)


def test_without_handles_with_reordered_coordinates_and_with_an_outline(tmp_path, rng):
    """Fixed vertices from the boundary, vt records in another order than the vertices, and an outline as target."""
    source = write_stars(tmp_path / "set", ["a", "b", "c"])
    (source / "a" / "handles.txt").unlink()
    mesh = io.read_mesh(source / "b" / "input.obj")
    order = rng.permutation(len(mesh.V))
    turned = io.MeshData(mesh.V, mesh.F, vt=mesh.vt[order], FT=np.argsort(order)[mesh.F])
    io.write_obj(source / "b" / "input.obj", turned)
    assert solved_both_ways(source, tmp_path) == [0, 1, 2]
    assert_as_alone(tmp_path, ["a", "b", "c"])
    outs = tmp_path / "onto"
    assert solved_both_ways(source, outs, to="letter:C") == [0, 1, 2]
    assert_as_alone(outs, [f"{name}/input.obj" for name in "abc"])


def test_unsolved_problems_are_left_unchanged(tmp_path):
    source = write_stars(tmp_path / "set", ["a", "broken", "closed", "far", "islands", "large", "z"])
    (source / "broken" / "input.obj").write_text("v 0 0 0\nf 1 2 3\n")
    tetrahedron = [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
    io.write_obj(source / "closed" / "input.obj", io.MeshData(np.eye(4)[:, :3], tetrahedron))
    V, F, loop, star = star_of(5)
    # The target outline intersects itself.
    write_problem(source / "far", V, F, loop, star * [1, 0] + np.roll(star, 7, axis=0) * [0, 1])
    both = np.concatenate([V, V + 3]), np.concatenate([F, F + len(V)])
    write_problem(source / "islands", *both, np.concatenate([loop, loop + len(V)]), np.concatenate([star, star + 3]))
    write_problem(source / "large", *star_of(26))
    (tmp_path / "together/results/broken").mkdir(parents=True)
    (tmp_path / "together/results/broken/record.json").write_text("{}")
    assert solved_both_ways(source, tmp_path) == [0, 6]
    assert_as_alone(tmp_path, ["a", "z"])
    assert not list((tmp_path / "together").rglob("[bcfil]*/map.obj"))
    assert (tmp_path / "together/results/broken/record.json").read_text() == "{}"
    # A run then solves them separately.
    assert batch.run(source, tmp_path / "run", jobs=1).total == 7
    for name in ("broken", "closed", "far", "islands", "large"):
        assert record_of(tmp_path / "run", name)["outcome"] == record_of(tmp_path / "alone", name)["outcome"]


@pytest.mark.parametrize(
    ("settings", "allowed"),
    [
        ({}, True),
        ({"to": "disk", "strategy": "paper", "reference": "equilateral"}, True),
        ({"polish": "mips"}, False),
        ({"refine": True}, False),
        ({"flatten": True}, False),
        ({"to": "disk", "cut": True}, False),
        ({"reference": "rest"}, False),
        ({"linear_solver": "qdldl"}, True),
        ({"linear_solver": "superlu"}, False),
    ],
)
def test_settings_that_allow_batching(settings, allowed):
    assert batch.Settings(**settings).together is allowed


def test_groups_consist_of_small_files_in_order(tmp_path):
    sizes = [10, 20, SMALL_FILE + 1, 30, *[SMALL_FILE] * 20, *[0] * 70]
    files = []
    for k, size in enumerate(sizes):
        path = tmp_path / f"{k}.obj"
        with open(path, "wb") as file:
            file.truncate(size)
        files.append(ProblemFiles(f"{k}", path, None))
    files.insert(2, ProblemFiles("gone", tmp_path / "gone.obj", None))
    groups = list(group_small(files))
    assert {name for group in groups for name in group} == set(files)
    for group in groups:
        sizes = [path.mesh.stat().st_size if path.mesh.exists() else SMALL_FILE + 1 for path in group]
        assert len(group) == 1 or (max(sizes) <= SMALL_FILE and sum(sizes) <= GROUP_OF_FILES and len(group) <= 64)
    assert [files[2]] in groups
    together_with = [group for group in groups if len(group) > 1]
    assert [file for group in together_with for file in group] == [f for f in files if [f] not in groups]


def test_a_run_stopped_within_a_group_resumes_there(tmp_path):
    names = [f"{k:02d}" for k in range(20)]
    source, out = write_stars(tmp_path / "set", names), tmp_path / "out"
    assert batch.run(source, tmp_path / "straight").solved == 20
    out.mkdir()
    one = supervisor.Supervisor(Orders(out, batch.Settings()))
    finished = one.attend_all(list(batch.find_problems(source)))
    first = next(finished)
    one.close()
    with pytest.raises(supervisor.ClosedError):
        list(finished)
    done = {path.parent.name: path.stat().st_mtime_ns for path in out.rglob("record.json")}
    assert first.name in done
    progress = batch.run(source, out)
    assert (progress.solved, progress.resumed) == (20, len(done))
    for name in names:
        paths = [folder / "results" / name / "map.obj" for folder in (out, tmp_path / "straight")]
        assert paths[0].read_bytes() == paths[1].read_bytes()
        record = out / "results" / name / "record.json"
        assert name not in done or record.stat().st_mtime_ns == done[name]
        assert json.loads(record.read_text())["certified"]


def test_a_run_solves_small_problems_in_batches(tmp_path, monkeypatch):
    """The worker process cannot solve separate problems, so all must be solved in a batch."""
    code = "from quasiharmonic.ui.batch import worker; worker.solve_files = None; worker.serve()"
    monkeypatch.setattr(supervisor, "COMMAND", [sys.executable, "-P", "-c", code])
    source = write_stars(tmp_path / "set", ["a", "b", "c"])
    assert batch.run(source, tmp_path / "out", jobs=1).outcomes == {"injective": 3}
    assert batch.run(source / "a", tmp_path / "polished", batch.Settings(polish="mips")).outcomes == {"crash": 1}
