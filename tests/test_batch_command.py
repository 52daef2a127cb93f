"""`qhm batch`: exit statuses, sizes, and what it prints."""

from __future__ import annotations

import contextlib
import os
import re
import sys

import pytest

from quasiharmonic.ui.cli import main, process
from quasiharmonic.ui.cli.commands import batch
from shared.datasets import write_stars

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]


class TestCommand:
    def test_exit_statuses(self, stars, tmp_path, capsys):
        out = str(tmp_path / "out")
        assert main(["batch", str(stars), "-o", out, "-j", "1", "--memory-limit", "2G"]) == 0
        said = capsys.readouterr()
        assert "4 of 4 problems have a certified injective map" in said.out
        assert said.err == ""
        (stars / "a" / "input.obj").write_text("nonsense")
        assert main(["batch", str(stars), "-o", out]) == 1
        assert "the others: 1 with unusable input" in capsys.readouterr().out
        assert main(["batch", str(stars / "b"), "-o", out, "-j", "1", "--flatten", "--energy", "mips"]) == 0
        assert "2 of 2 problems have a certified bijective map" in capsys.readouterr().out
        sliding = ["--polish", "mips", "--slide"]
        assert main(["batch", str(stars / "b"), "-o", out, "-j", "1", "--to", "disk", *sliding]) == 0
        assert main(["batch", str(stars / "b"), "-o", out, "--slide"]) == 2
        assert "give an energy as well, by --polish" in capsys.readouterr().err
        assert main(["batch", str(tmp_path / "none"), "-o", out]) == 2
        assert "there is no folder" in capsys.readouterr().err

    def test_full_disk(self, tmp_path, capsys, failing_worker):
        write_stars(tmp_path / "set", ["full"])
        assert main(["batch", str(tmp_path / "set"), "-o", str(tmp_path / "out")]) == 2
        assert "o space left" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("text", "value"), [("800M", 800 << 20), ("4G", 4 << 30), ("1.5 GiB", 3 << 29), ("7k", 7168)]
    )
    def test_sizes(self, text, value, monkeypatch):
        asked = []

        def run(*arguments, memory_limit, **options):
            asked.append(memory_limit)
            raise KeyboardInterrupt

        monkeypatch.setattr("quasiharmonic.ui.batch.run", run)
        assert main(["batch", "set", "-o", "out", "--memory-limit", text]) == 2
        assert asked == [value]

    @pytest.mark.parametrize("text", ["", "4X", "-1G", "0", "1.2.3G", "."])
    def test_invalid_sizes(self, text, capsys):
        with pytest.raises(SystemExit) as stop:
            main(["batch", "set", "-o", "out", f"--memory-limit={text}"])
        assert stop.value.code == 2
        assert "is not a size" in capsys.readouterr().err

    def test_on_a_terminal_and_in_a_log(self, stars, tmp_path, capsys, monkeypatch):
        pty = pytest.importorskip("pty")
        # Print every problem, however fast they follow each other.
        monkeypatch.setattr(batch, "LIVE", 0)
        monkeypatch.setattr(process, "LOG", 0)
        command = ["batch", str(stars), "-j", "1", "-o"]
        leader, follower = pty.openpty()
        with os.fdopen(follower, "w") as terminal, monkeypatch.context() as patch:
            patch.setattr(sys, "stderr", terminal)
            assert main([*command, str(tmp_path / "1")]) == 0
        shown = ""
        # At the terminal's end, reading raises an error on Linux and returns nothing elsewhere.
        with contextlib.suppress(OSError):
            while part := os.read(leader, 1 << 12):
                shown += part.decode()
        os.close(leader)
        assert re.search(r"\d/4 done   0 failed   \S+/s", shown)
        assert " left" in shown
        assert re.search(r"\r +\r$", shown)
        assert main([*command, str(tmp_path / "2")]) == 0
        log = capsys.readouterr().err
        assert log.splitlines()[-1].startswith("4/4 done")
        assert "\r" not in log
