"""Code tested on Linux alone makes few assumptions: file names, integers, and features that systems may lack."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

import quasiharmonic
from shared.datasets import record_of, write_stars

ROOT = Path(quasiharmonic.__file__).parent
HERE = Path(__file__).parent
# Python's modules that some systems lack.
SOMEWHERE = {"curses", "fcntl", "grp", "msvcrt", "posix", "pty", "pwd", "resource", "syslog", "termios", "winreg"}
# Types whose size depends on the system: `int` as an array type is C's `long` in NumPy 1, and `longdouble` varies.
SIZED_BY_THE_SYSTEM = re.compile(
    r"\b(np|ctypes)\.(c_u?long|u?int_?|u?long|c?longdouble|float128|complex256)\b|dtype=int\b|astype\(int\b"
)


def sources():
    """Yield names and texts of the package's files."""
    for path in sorted(ROOT.rglob("*.py")):
        yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def minded(tree):
    """Yield imports in the body of a `try` that handles their failure."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Try) and node.handlers:
            yield from (id(inner) for step in node.body for inner in ast.walk(step) if isinstance(inner, ast.Import))


@pytest.mark.parametrize("folder", [ROOT, HERE], ids=["the package", "tests"])
def test_file_names_are_valid_everywhere(folder):
    """No two names differ by case alone, and none is a Windows device or has a character that Windows rejects."""
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if "__pycache__" not in path.parts]
    assert names
    assert max(Counter(name.lower() for name in names).values()) == 1
    devices = re.compile(r"(^|/)(con|prn|aux|nul|com\d|lpt\d)(\.|/|$)", re.IGNORECASE)
    assert not [name for name in names if devices.search(name) or re.search(r'[<>:"\\|?*]|[. ](/|$)', name)]


@pytest.mark.slow
def test_no_type_of_system_dependent_size():
    assert SIZED_BY_THE_SYSTEM.search("np.zeros(3, dtype=int)")
    assert not SIZED_BY_THE_SYSTEM.search("np.zeros(3, dtype=np.int64)")
    lines = [(name, line) for name, text in sources() for line in text.splitlines() if ">>> " not in line]
    assert not [(name, line) for name, line in lines if SIZED_BY_THE_SYSTEM.search(line)]


def test_imports_that_a_system_may_lack_are_guarded():
    seen = set()
    for name, text in sources():
        if not re.search(rf"import ({'|'.join(SOMEWHERE)})\b|from ({'|'.join(SOMEWHERE)}) ", text):
            continue
        tree = ast.parse(text)
        well = set(minded(tree))
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                assert node.module not in SOMEWHERE, f"{name}:{node.lineno}"
            elif isinstance(node, ast.Import) and SOMEWHERE & {alias.name for alias in node.names}:
                assert id(node) in well, f"{name}:{node.lineno}"
                seen.add(name)
    assert "ui/batch/shards.py" in seen, "this test sees nothing"


# Every Python process with this on its path simulates a system without Unix modules and without /proc.
_ELSEWHERE = """
import builtins, io, os, signal, sys
for name in ("fcntl", "resource", "pwd", "grp", "termios", "pty", "psutil"):
    sys.modules[name] = None
for module, names in {
    os: ("fork", "getuid", "geteuid", "sched_getaffinity", "getpgid", "killpg", "mkfifo", "sysconf"),
    signal: ("SIGALRM", "SIGHUP", "SIGUSR1", "alarm", "setitimer"),
}.items():
    for name in names:
        delattr(module, name)
opened = io.open
def opens(file, *more, **named):
    if str(file).startswith("/proc"):
        raise FileNotFoundError(file)
    return opened(file, *more, **named)
io.open = builtins.open = opens
"""


@pytest.mark.long
def test_a_data_set_is_solved_on_a_system_without_unix_features(tmp_path):
    """The encoding has few characters, and some names contain others."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "sitecustomize.py").write_text(_ELSEWHERE, encoding="utf-8")
    stars = write_stars(tmp_path / "sét", ["Größe", "b"])
    path = os.pathsep.join([str(tmp_path / "elsewhere"), str(ROOT.parent)])
    surroundings = os.environ | {"PYTHONPATH": path, "PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "quasiharmonic", "batch", str(stars), "-o", str(tmp_path / "out"), "--jobs", "1"]
    seen = [sys.executable, "-c", "import os, fcntl"]
    assert b"fcntl" in subprocess.run(seen, env=surroundings, capture_output=True).stderr, "this test changes nothing"
    done = subprocess.run(command, env=surroundings, capture_output=True, timeout=600)
    assert done.returncode == 0, done.stderr.decode("cp1252", "replace")
    record = record_of(tmp_path / "out", "Größe")
    assert record["outcome"] == "injective"
    assert record["peak_memory"] is None
