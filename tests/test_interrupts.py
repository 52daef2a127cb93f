"""Ctrl-C on the command: whenever it comes, it ends the command, in a sentence and with its exit status."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import quasiharmonic
from quasiharmonic.ui.cli import main
from quasiharmonic.ui.cli.commands import measure

# Calls the command in a process whose imports are interrupted at a module's name.
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
    """The command, as its console script calls it, with Ctrl-C when some module is looked for."""
    return subprocess.run(
        [sys.executable, "-c", INTERRUPTED, at, ENTRY, *map(str, arguments)], capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize(
    "at", ["argparse", "quasiharmonic.ui.cli", "quasiharmonic.ui.cli.commands.map", "quasiharmonic.ui.cli.sliding"]
)
def test_while_the_command_itself_is_loaded(at):
    done = interrupted(at, "map", "in.obj", "-o", "out.obj")
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "qhm: interrupted, nothing was written\n")


@pytest.mark.parametrize("at", ["quasiharmonic.io", "numpy", "numpy.linalg", "quasiharmonic.util.arrays"])
def test_while_what_it_needs_is_loaded(tmp_path, at):
    path = tmp_path / "grid.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    done = interrupted(at, "check", path)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "qhm check: interrupted, nothing was written\n")


def test_in_a_finaliser(monkeypatch, capsys):
    class Closing:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def run(options):
        closing = Closing()
        del closing
        time.sleep(10)
        return 0

    monkeypatch.setattr(measure, "run", run)
    began = time.monotonic()
    assert main(["measure", "map.obj"]) == 2
    assert time.monotonic() - began < 5
    assert capsys.readouterr().err == "qhm measure: interrupted, nothing was written\n"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_turned_into_another_error(monkeypatch, capsys):
    # As extension modules do that are interrupted while they are loaded.
    def run(options):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise SystemError("initialization failed") from None

    monkeypatch.setattr(measure, "run", run)
    assert main(["measure", "map.obj"]) == 2
    assert capsys.readouterr().err == "qhm measure: interrupted, nothing was written\n"


def test_out_of_code_that_is_made_on_the_way(tmp_path):
    # As dataclasses make theirs. The interpreter takes such an interrupt for one that nobody has caught.
    (tmp_path / "sitecustomize.py").write_text(
        "import sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, *_):\n"
        "        if name == 'quasiharmonic.io':\n"
        "            exec('raise KeyboardInterrupt')\n"
        "sys.meta_path.insert(0, Interrupting())\n"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(quasiharmonic.__file__).parents[1])])
    done = subprocess.run(
        [sys.executable, "-m", "quasiharmonic", "check", "grid.off"],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (done.returncode, done.stderr) == (2, "qhm check: interrupted, nothing was written\n")


def test_not_where_it_is_ignored(monkeypatch):
    # As by a shell for what runs in the background.
    monkeypatch.setattr(measure, "run", lambda options: signal.raise_signal(signal.SIGINT) or 0)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert main(["measure", "map.obj"]) == 0
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_after_the_last_word():
    # Too late to undo anything: what has been said stays true.
    late = "import signal; atexit.register(signal.raise_signal, signal.SIGINT)"
    code = f"import atexit, sys; {late}; sys.argv[1:] = ['--version']; from quasiharmonic.__main__ import main; main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("qhm ")
