"""Data sets on one machine: every problem is recorded, and a failure does not affect other problems."""

from __future__ import annotations

import json
import os
import sys
import time
import tracemalloc

import numpy as np
import pytest

from quasiharmonic import batch, certify, io
from quasiharmonic.ui.batch import records, supervisor
from quasiharmonic.ui.batch import settings as settings_module
from quasiharmonic.ui.batch.settings import sources
from quasiharmonic.ui.batch.supervisor import Finished
from quasiharmonic.ui.cli import main
from shared.datasets import record_of, star_of, write_problem, write_stars

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]


class TestRun:
    def test_maps_and_records(self, stars, tmp_path):
        seen = []
        progress = batch.run(stars, tmp_path / "out", jobs=2, callback=lambda p: seen.append((p.done, p.failed)))
        assert (progress.total, progress.done, progress.solved, progress.failed) == (4, 4, 4, 0)
        assert progress.outcomes == {"injective": 4}
        assert seen[-1] == (4, 0)
        for name in ("a", "b/c", "b/d/e", "z"):
            mesh = io.read_mesh(stars / name / "input.obj")
            written = io.read_mesh(tmp_path / "out" / "results" / name / "map.obj")
            fixed = io.read_handles(stars / name / "handles.txt", len(mesh.V))
            uv = io.map_of(written)
            np.testing.assert_array_equal(written.V, mesh.V)
            np.testing.assert_array_equal(written.F, mesh.F)
            np.testing.assert_array_equal(uv[fixed], io.map_of(mesh)[fixed])
            assert certify(mesh.F, uv).injective
            record = record_of(tmp_path / "out", name)
            assert record["certified"]
            assert (record["vertices"], record["triangles"]) == (len(mesh.V), len(mesh.F))
            assert record["flips_after"] == 0
            assert record["iterations"] == sum(stage["n_iterations"] for stage in json.loads(record["stages"]))
            parts = [v for k, v in record.items() if k.startswith("seconds_")]
            assert 0 < sum(parts) <= record["seconds"]
            assert record["mips"] > 0
            assert record["isometric"] >= 1
            assert set(json.loads(record["versions"])) == {"quasiharmonic", "python", "numpy", "scipy"}
            assert set(record) <= set(batch.COLUMNS)
        assert record["flips_before"] > 0  # of the last problem; the first ones are easy
        table = list(batch.read_table(tmp_path / "out" / "records.csv"))
        assert [row["problem"] for row in table] == ["a", "b/c", "b/d/e", "z"]
        for row in table:
            expected = record_of(tmp_path / "out", row["problem"])
            assert {k: v for k, v in row.items() if v is not None} == {
                k: v for k, v in expected.items() if v is not None
            }

    def test_distortion_is_that_of_the_map(self, stars, tmp_path):
        """Compare with singular values computed in the test."""
        batch.run(stars / "a", tmp_path / "out", batch.Settings(polish="mips"))
        mesh = io.read_mesh(tmp_path / "out" / "results" / "a" / "map.obj")
        a, b, c = mesh.V[mesh.F, :2].transpose(1, 0, 2)
        p, q, r = io.map_of(mesh)[mesh.F].transpose(1, 0, 2)
        J = np.stack([q - p, r - p], axis=2) @ np.linalg.inv(np.stack([b - a, c - a], axis=2))
        sigma = np.linalg.svd(J, compute_uv=False)
        area = np.abs(np.cross(np.pad(b - a, [(0, 0), (0, 1)]), np.pad(c - a, [(0, 0), (0, 1)]))[:, 2])
        ratio = sigma[:, 0] / sigma[:, 1]
        record = record_of(tmp_path / "out", "a")
        assert record["mips"] == pytest.approx(np.average(ratio + 1 / ratio - 2, weights=area), rel=1e-9)
        sigma = sigma * np.sqrt(area.sum() / (area * sigma.prod(axis=1)).sum())
        assert record["isometric"] == pytest.approx(max(sigma.max(), 1 / sigma.min()), rel=1e-9)
        assert record["seconds_polish"] > 0
        assert record["status"] == "polished"

    def test_a_rerun_solves_new_problems_only(self, stars, tmp_path):
        out = tmp_path / "out"
        batch.run(stars, out, jobs=1)
        stamps = {path: path.stat().st_mtime_ns for path in out.rglob("map.obj")}
        write_problem(stars / "a", *star_of(4))  # other contents
        (out / "results/b/c/record.json").write_text('{"key": "cut sho')
        os.truncate(out / "results/b/d/e/map.obj", 100)  # as a power failure might
        (out / "results/b/c/.qhm-0123.tmp").write_text("left by a kill")
        progress = batch.run(stars, out, jobs=1)
        assert (progress.solved, progress.resumed) == (4, 1)
        again = {path for path, stamp in stamps.items() if path.stat().st_mtime_ns != stamp}
        assert again == {out / "results" / name / "map.obj" for name in ("a", "b/c", "b/d/e")}
        assert not list(out.rglob("*.tmp"))
        assert batch.run(stars, out, jobs=1).resumed == 4
        assert batch.run(stars, out, batch.Settings(strategy="paper"), jobs=1).resumed == 0

    def test_problems_of_another_version_are_solved_again(self, stars, tmp_path, monkeypatch):
        assert batch.run(stars / "a", tmp_path / "out").resumed == 0
        assert batch.run(stars / "a", tmp_path / "out").resumed == 1
        package = tmp_path / "package"
        (package / "ui" / "report").mkdir(parents=True)
        monkeypatch.setattr(settings_module, "__file__", str(package / "ui" / "batch" / "settings.py"))
        states = []
        for file, text in (
            ("__init__.py", ""),
            ("solving.py", "a = 1"),
            ("solving.py", "a = 2"),
            ("ui/report/page.py", "only shows"),
        ):
            (package / file).write_text(text)
            states.append(settings_module.sources_digest.__wrapped__())
        assert len(set(states)) == 3
        assert states[2] == states[3]
        monkeypatch.setattr(settings_module, "sources_digest", lambda: states[0])
        assert batch.run(stars / "a", tmp_path / "out").resumed == 0

    def test_one_run_at_a_time(self, stars, tmp_path):
        pytest.importorskip("fcntl")
        out, refused = tmp_path / "out", []

        def again(progress):
            with pytest.raises(OSError, match=r"another run is writing to .*out"):
                batch.run(stars, out)
            refused.append(progress.done)

        assert batch.run(stars, out, jobs=1, callback=again).solved == 4
        assert refused[-1] == 4
        assert batch.run(stars, out).resumed == 4

    def test_files_of_other_origin_are_not_overwritten(self, stars, tmp_path):
        for out in (stars, stars / "b", stars / "a"):
            with pytest.raises(ValueError, match=r"contains a problem, .*input.obj: choose another folder"):
                batch.run(stars, out)
            assert not list(stars.rglob("qhm-batch*"))
        (tmp_path / "records.csv").write_text("mine")
        with pytest.raises(OSError, match=r"has a records.csv that belongs to no run"):
            batch.run(stars, tmp_path)
        assert (tmp_path / "records.csv").read_text() == "mine"
        assert not (tmp_path / "results").exists()
        # An output folder above the problems is allowed.
        (tmp_path / "records.csv").unlink()
        assert batch.run(stars / "b", stars).solved == batch.run(stars / "b", stars).resumed == 2

    def test_no_process_starts_if_everything_is_done(self, stars, tmp_path, monkeypatch):
        batch.run(stars, tmp_path / "out", jobs=1)
        monkeypatch.setattr(supervisor, "COMMAND", ["/nonexistent"])
        assert batch.run(stars, tmp_path / "out").resumed == 4

    def test_rejected_calls(self, stars, tmp_path):
        (tmp_path / "empty").mkdir()
        with pytest.raises(ValueError, match=r"no problems in .*empty"):
            batch.run(tmp_path / "empty", tmp_path / "out")
        for wrong in ({"jobs": 0}, {"threads": 0}, {"time_limit": -1.0}, {"memory_limit": 0}, {"table": "xls"}):
            with pytest.raises(ValueError, match=next(iter(wrong)) if "table" not in wrong else "csv or .parquet"):
                batch.run(stars, tmp_path / "out", **wrong)
        for name, value in (
            ("strategy", "hope"),
            ("polish", "soap"),
            ("reference", "x"),
            ("linear_solver", "abacus"),
            ("max_iterations", 0),
        ):
            with pytest.raises(ValueError, match=f"{name} must be .*, not {value!r}"):
                batch.run(stars, tmp_path / "out", batch.Settings(**{name: value}))
        with pytest.raises(ValueError, match="jobs"):
            batch.run(stars, tmp_path / "out", jobs=2, scheduler="tcp://localhost:1")
        assert not (tmp_path / "out").exists()
        (tmp_path / "file").write_text("")
        with pytest.raises(OSError, match="cannot create the folder"):
            batch.run(stars, tmp_path / "file" / "out")
        with pytest.raises(OSError, match="it is not a folder"):
            batch.run(stars, tmp_path / "file")

    def test_worker_that_does_not_start(self, stars, tmp_path, monkeypatch, capsys):
        monkeypatch.setattr(supervisor, "COMMAND", [sys.executable, "-c", "raise SystemExit('no such luck')"])
        with pytest.raises(batch.WorkerError, match="no such luck"):
            batch.run(stars, tmp_path / "out")
        monkeypatch.setattr(supervisor, "COMMAND", ["/nonexistent"])
        assert main(["batch", str(stars), "-o", str(tmp_path / "out")]) == 2
        assert "cannot start /nonexistent" in capsys.readouterr().err

    def test_memory_of_the_driver_does_not_grow_with_the_problems(self, tmp_path, monkeypatch):
        """Hundreds of folders, each with one unread file."""

        def attend_all(supervisor, some):
            for files in some:
                folder = supervisor.orders.folder(files)
                records.clear(folder)
                records.write_record(folder, {"problem": files.name, "outcome": "injective"})
                yield Finished(files.name, "injective", 0.0)

        def look(progress):
            if progress.done in (100, 400):
                held = tracemalloc.take_snapshot().filter_traces([tracemalloc.Filter(True, "*/batch/*.py")])
                sizes[progress.done] = sum(trace.size for trace in held.traces)

        monkeypatch.setattr(supervisor.Supervisor, "attend_all", attend_all)
        for k in range(400):
            folder = tmp_path / "set" / f"{k // 50}" / f"{k}"
            folder.mkdir(parents=True)
            (folder / "input.obj").touch()
        sizes = {}
        tracemalloc.start()
        try:
            assert batch.run(tmp_path / "set", tmp_path / "out", jobs=1, callback=look).solved == 400
        finally:
            tracemalloc.stop()
        # A list of the problems would take 150 kB.
        assert sizes[400] < sizes[100] + 50_000

    def test_an_interrupt_stops_at_once_and_keeps_finished_results(self, stars, tmp_path, failing_worker):
        write_stars(stars, ["y_sleep"])

        def interrupt(progress):
            if progress.done >= 3:
                raise KeyboardInterrupt

        began = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            batch.run(stars, tmp_path / "out", jobs=2, callback=interrupt)
        assert time.monotonic() - began < 120
        assert not (tmp_path / "out/results/y_sleep/record.json").exists()
        assert record_of(tmp_path / "out", "a")["certified"]


def test_records_depend_on_every_source_that_changes_results():
    names = [name for name, _ in sources()]
    assert {"solver/field/tensor.py", "util/kernels/__init__.py", "ui/batch/worker.py"} <= {*names}
    assert not [name for name in names if name.startswith("ui/cli/")]
