"""Ctrl-C during the command: at any time, it ends the command with a message and the proper exit status."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib
from contextlib import contextmanager
from pathlib import Path

import pytest

import quasiharmonic
from quasiharmonic import io
from quasiharmonic.surfaces import cat
from quasiharmonic.ui.cli import main, process
from quasiharmonic.ui.cli.commands import measure

# Calls the command in a process and interrupts it when a module with a given name is imported.
INTERRUPTED = """
import importlib, signal, sys

class Interrupting:
    def find_spec(self, name, *_):
        if name == at:
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)

at, entry, *sys.argv[1:] = sys.argv[1:]
sys.meta_path.insert(0, Interrupting())
module, function = entry.split(":")
raise SystemExit(getattr(importlib.import_module(module), function)())
"""
ENTRY = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["scripts"]["qhm"]


def interrupted(at, *arguments):
    """Run the command as its console script does, with Ctrl-C when a given module is imported."""
    return subprocess.run(
        [sys.executable, "-c", INTERRUPTED, at, ENTRY, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=600,
    )


@pytest.mark.parametrize(
    "at",
    [
        "argparse",
        "quasiharmonic.ui.cli",
        "quasiharmonic.ui.cli.commands.map",
        "quasiharmonic.ui.cli.map_options",
        "quasiharmonic.io",
    ],
)
def test_while_the_command_itself_is_imported(at):
    done = interrupted(at, "map", "in.obj", "-o", "out.obj")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "qhm: interrupted, nothing was written\n")


@pytest.mark.slow
@pytest.mark.parametrize("at", ["numpy", "numpy.linalg", "quasiharmonic.util.arrays"])
def test_while_its_dependencies_are_imported(tmp_path, at):
    path = tmp_path / "grid.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    done = interrupted(at, "check", path)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "qhm check: interrupted, nothing was written\n")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_in_a_finaliser(monkeypatch, capsys, name):
    if not hasattr(signal, name):
        pytest.skip("the system has no such signal")
    number = getattr(signal, name)

    class Closing:
        def __del__(self):
            signal.raise_signal(number)

    def run(options):
        closing = Closing()
        del closing
        time.sleep(20)
        return 0

    monkeypatch.setattr(measure, "run", run)
    # Shells ignore Ctrl-C for background processes.
    handlers = {number: signal.SIG_DFL, signal.SIGINT: signal.SIG_IGN} | (
        {number: signal.default_int_handler} if name == "SIGINT" else {}
    )
    before = {each: signal.signal(each, handler) for each, handler in handlers.items()}
    began = time.monotonic()
    try:
        assert main(["measure", "map.obj"]) == 2
        assert time.monotonic() - began < 15
        assert capsys.readouterr().err == "qhm measure: interrupted, nothing was written\n"
        assert all(signal.getsignal(each) is handler for each, handler in handlers.items())
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def test_turned_into_another_error(monkeypatch, capsys):
    # Some extension modules do this if they are interrupted during import.
    def run(options):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise SystemError("initialization failed") from None

    monkeypatch.setattr(measure, "run", run)
    assert main(["measure", "map.obj"]) == 2
    assert capsys.readouterr().err == "qhm measure: interrupted, nothing was written\n"


def test_in_generated_code(tmp_path):
    # For example, in code that dataclasses generate. The interpreter reports such an interrupt as uncaught.
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'numpy':\n"
        "            exec('raise KeyboardInterrupt')\n"
        "sys.meta_path.insert(0, Interrupting())\n"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(quasiharmonic.__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-m", "quasiharmonic", "check", "grid.off"],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (done.returncode, done.stderr) == (2, "qhm check: interrupted, nothing was written\n")


def test_not_if_interrupts_are_ignored(monkeypatch):
    # A shell does this for background processes.
    monkeypatch.setattr(measure, "run", lambda options: signal.raise_signal(signal.SIGINT) or 0)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert main(["measure", "map.obj"]) == 0
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow
def test_after_the_last_output():
    # Too late to undo anything: the printed report stays true.
    late = "import signal; atexit.register(signal.raise_signal, signal.SIGINT)"
    code = f"import atexit, sys; {late}; sys.argv[1:] = ['--version']; from quasiharmonic.__main__ import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("qhm ")


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_of_schedulers_and_terminals_are_interrupts(monkeypatch, capsys, name):
    if not hasattr(signal, name):
        pytest.skip("the system has no such signal")
    number = getattr(signal, name)
    monkeypatch.setattr(measure, "run", lambda options: signal.raise_signal(number) or 0)
    # Shells ignore Ctrl-C for background processes, and nohup ignores SIGHUP.
    for interrupt, handler, status in (
        (signal.default_int_handler, signal.SIG_DFL, 2),
        (signal.SIG_IGN, signal.SIG_DFL, 2),
        (signal.default_int_handler, signal.SIG_IGN, 0),
    ):
        before = signal.signal(signal.SIGINT, interrupt), signal.signal(number, handler)
        try:
            assert main(["measure", "map.obj"]) == status
            assert signal.getsignal(number) is handler
        finally:
            signal.signal(signal.SIGINT, before[0])
            signal.signal(number, before[1])
        assert capsys.readouterr().err == ("qhm measure: interrupted, nothing was written\n" if status else "")


@pytest.mark.slow
def test_sigterm_keeps_the_map(tmp_path, monkeypatch, capsys):
    V, F = cat(8)
    io.write_mapped(tmp_path / "in.obj", io.MeshData(V, F).with_map(V[:, :2]))
    steps = []

    @contextmanager
    def line(*_):
        def show(step):
            steps.append(step)
            if len(steps) == 4:
                signal.raise_signal(signal.SIGTERM)

        yield show

    monkeypatch.setattr(process, "progress_line", line)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert main(["flatten", str(tmp_path / "in.obj"), "-o", str(tmp_path / "out.obj")]) == 0
    finally:
        signal.signal(signal.SIGINT, before)
    assert "best map so far" in capsys.readouterr().out
    assert len(steps) == 4
    assert main(["check", str(tmp_path / "out.obj")]) == 0
