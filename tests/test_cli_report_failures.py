"""``qhm``: after a map is written, no error message claims that nothing was written."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.surfaces import grid
from shared.commands import run


class TestReportFailures:
    """After a map is written, an error message must not claim that nothing was written."""

    @pytest.mark.slow
    def test_full_standard_output(self, star, tmp_path):
        if os.name != "posix" or not Path("/dev/full").exists():
            pytest.skip("no /dev/full on this system")
        command = [sys.executable, "-m", "quasiharmonic", "map", str(star), "-o", str(tmp_path / "o.obj")]
        with open("/dev/full", "w", encoding="utf-8") as full:
            done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
        assert done.returncode == 3
        assert "is written, but the report failed" in done.stderr
        assert "Traceback" not in done.stderr
        assert run("check", tmp_path / "o.obj") == 0

    @pytest.mark.long
    @pytest.mark.parametrize(("arguments", "both"), [("map {} -o {}", True), ("measure {} --export {}", False)])
    def test_full_standard_error_and_exports(self, star, tmp_path, arguments, both):
        if os.name != "posix" or not Path("/dev/full").exists():
            pytest.skip("no /dev/full on this system")
        written = tmp_path / ("o.obj" if both else "o.csv")
        command = [sys.executable, "-m", "quasiharmonic", *arguments.format(star, written).split()]
        with open("/dev/full", "w", encoding="utf-8") as full:
            done = subprocess.run(command, stdout=full, stderr=full if both else subprocess.DEVNULL)
        assert done.returncode == 3
        assert written.exists()

    @pytest.mark.long
    @pytest.mark.skipif(os.name != "posix", reason="closes a stream by the shell")
    @pytest.mark.parametrize(("more", "status"), [("| true", 3), (">&-", 0), ("--json - >&-", 3)])
    def test_closed_standard_output(self, star, tmp_path, more, status):
        command = f"set -o pipefail; {sys.executable} -m quasiharmonic map {star} -o {tmp_path / 'o.obj'} {more}"
        done = subprocess.run(["bash", "-c", command], stderr=subprocess.PIPE, text=True)
        assert done.returncode == status
        assert ("is written, but the report failed" in done.stderr) == (status == 3)
        assert "Traceback" not in done.stderr
        assert run("check", tmp_path / "o.obj") == 0

    def test_interrupt_while_drawing(self, star, tmp_path, capsys, monkeypatch):
        def interrupt(*arguments, **more):
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.ui.plot.save_map_figure", interrupt)
        assert run("map", star, "-o", tmp_path / "o.obj", "--plot", tmp_path / "p.png") == 3
        assert "o.obj is written; interrupted" in capsys.readouterr().err

    def test_interrupt_while_the_written_map_is_certified(self, star, tmp_path, capsys, monkeypatch):
        def interrupt(mesh):
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.io.mapped", interrupt)
        assert run("map", star, "-o", tmp_path / "o.obj") == 3
        assert "o.obj is written; interrupted" in capsys.readouterr().err
        assert (tmp_path / "o.obj").exists()

    def test_interrupt_before_there_is_a_map(self, star, tmp_path, capsys, monkeypatch):
        def interrupt(self, xi):
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.solver.field.objective.Objective.evaluate", interrupt)
        assert run("map", star, "-o", tmp_path / "o.obj") == 2
        assert "nothing was written" in capsys.readouterr().err
        assert not (tmp_path / "o.obj").exists()

    @pytest.mark.slow
    def test_reports_are_printed_on_an_ascii_console(self, star, tmp_path):
        command = [sys.executable, "-m", "quasiharmonic", "check", str(star)]
        plain = {
            **os.environ,
            "LC_ALL": "C",
            "PYTHONUTF8": "0",
            "PYTHONCOERCECLOCALE": "0",
            "PYTHONIOENCODING": "ascii",
        }
        done = subprocess.run(command, capture_output=True, env=plain)
        assert done.returncode == 1
        assert done.stdout.isascii()

    @pytest.mark.long
    @pytest.mark.skipif(os.name != "posix", reason="closes a stream by the shell")
    def test_closed_standard_error(self, star, tmp_path):
        command = f"{sys.executable} -m quasiharmonic map {star} -o {tmp_path / 'o.obj'} 2>&-"
        assert subprocess.run(command, shell=True, capture_output=True).returncode == 0

    @pytest.mark.slow
    def test_distortion_is_drawn(self, star, tmp_path):
        from matplotlib.image import imread

        out, picture = tmp_path / "o.obj", tmp_path / "p.png"
        assert run("map", star, "-o", out, "--plot", picture, "--kind", "distortion") == 0
        assert run("plot", out, "-o", tmp_path / "again.png", "--kind", "distortion") == 0
        # The picture is the same as that of the written file.
        np.testing.assert_array_equal(imread(picture), imread(tmp_path / "again.png"))

    @pytest.mark.slow
    def test_all_islands_are_drawn_if_one_was_mapped(self, tmp_path):
        (V, F), (W, G) = grid(8, 8), grid(5, 5)
        two = io.MeshData(np.concatenate([V, W + np.array([3, 0])]), np.concatenate([F, G + len(V)]))
        io.write_obj(tmp_path / "two.obj", two.with_map(two.V[:, :2]))
        call = "map", tmp_path / "two.obj", "--to", "disk", "--islands", "1", "-o", tmp_path / "o.obj"
        for more in ((), ("--refine",), ("--kind", "distortion")):
            assert run(*call, "--plot", tmp_path / "p.png", *more, "--json", tmp_path / "r.json") == 0
            assert json.loads((tmp_path / "r.json").read_text())["linear_solver"]

    @pytest.mark.slow
    def test_no_first_map_to_draw(self, star, tmp_path, monkeypatch):
        from quasiharmonic.linsolve import NotPositiveDefinite

        def fail(*arguments, **more):
            raise NotPositiveDefinite("as asked")

        monkeypatch.setattr("quasiharmonic.solver.mapping.quasi_harmonic_map", fail)
        assert run("map", star, "-o", tmp_path / "o.obj", "--plot", tmp_path / "p.png") == 0
        assert (tmp_path / "p.png").exists()


@pytest.mark.long
def test_progress_on_a_terminal_only(star, tmp_path, monkeypatch):
    """On a pseudo-terminal, progress lines are overwritten, and nothing remains."""
    pty = pytest.importorskip("pty")
    leader, follower = pty.openpty()
    with os.fdopen(follower, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        assert run("map", star, "-o", tmp_path / "out.obj") == 0
        shown = os.read(leader, 1 << 16).decode()
    os.close(leader)
    assert "iteration" in shown
    assert "inverted 0" in shown
    assert re.search(r"\r +\r$", shown)
