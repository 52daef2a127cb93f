"""A written file is complete or as before, whatever fails."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshData, OutputError, atomic
from quasiharmonic.io.errors import FileInUseError

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX")


def left_in(folder):
    return sorted(p.name for p in folder.iterdir())


def test_bytes_and_functions_are_written(tmp_path):
    path = tmp_path / "file"
    io.write_whole(path, b"one")
    assert path.read_bytes() == b"one"
    io.write_whole(str(path), lambda file: file.write(b"two"))
    assert path.read_bytes() == b"two"
    assert left_in(tmp_path) == ["file"]


def in_use(attempts):
    """Return a function that replaces a file after some attempts while another program has it open."""
    error = PermissionError(13, "Access is denied")
    error.winerror = 5
    errors = [error] * attempts

    def replace(old, new, move=os.replace):
        if errors:
            raise errors.pop()
        move(old, new)

    return replace


@pytest.mark.slow
def test_a_file_that_another_program_has_open_is_tried_again(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    monkeypatch.setattr(os, "replace", in_use(3))
    io.write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    monkeypatch.setattr(atomic, "PATIENCE", 0.1)
    monkeypatch.setattr(os, "replace", in_use(1000))
    with pytest.raises(FileInUseError, match="another program has it open"):
        io.write_whole(path, b"newer")
    assert path.read_bytes() == b"new"
    assert left_in(tmp_path) == ["file"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyError("x"), KeyboardInterrupt()])
def test_failure_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "file"

    def fail(file):
        file.write(b"half")
        raise error

    expected = OutputError if isinstance(error, OSError) else type(error)
    for before in ([], ["file"]):
        with pytest.raises(expected):
            io.write_whole(path, fail)
        assert left_in(tmp_path) == before
        path.write_bytes(b"old")
    assert path.read_bytes() == b"old"


def test_paths_that_cannot_be_written(tmp_path):
    mesh = MeshData([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    (tmp_path / "folder.obj").mkdir()
    (tmp_path / "file").write_bytes(b"")
    for path, message in (
        (tmp_path / "none" / "a.obj", "there is no directory"),
        (tmp_path / "file" / "a.obj", "there is no directory|Not a directory"),
        (tmp_path / "folder.obj", "it is a directory"),
        *([(tmp_path / ("x" * 5000 + ".obj"), "cannot write")] if os.name == "posix" else []),
        ("a\0b.obj", "cannot write"),
    ):
        with pytest.raises(OutputError, match=message):
            io.write_map(path, mesh, mesh.V[:, :2])
        with pytest.raises(OutputError, match=message):
            io.check_output(path)
    io.check_output(tmp_path / "new.obj")
    assert left_in(tmp_path) == ["file", "folder.obj"]


@posix
def test_devices_are_not_replaced():
    with pytest.raises(OutputError, match="not a regular file"):
        io.write_whole("/dev/null", b"")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)


@posix
def test_permissions_and_links_are_preserved(tmp_path):
    path, link = tmp_path / "file", tmp_path / "link"
    old = os.umask(0o027)
    try:
        io.write_whole(path, b"new")
    finally:
        os.umask(old)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    path.chmod(0o604)
    link.symlink_to(path)
    io.write_whole(link, b"newer")
    assert stat.S_IMODE(path.stat().st_mode) == 0o604
    assert link.is_symlink()
    assert path.read_bytes() == b"newer"


def test_write_protection_is_respected(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    # The error that a user without root rights would get.
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != path)
    with pytest.raises(OutputError, match="write-protected"):
        io.write_whole(path, b"new")
    monkeypatch.setattr(os, "access", lambda place, mode: False)
    with pytest.raises(OutputError, match="is not writable"):
        io.write_whole(path, b"new")
    assert path.read_bytes() == b"old"


@posix
def test_a_full_disk_keeps_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    script = f"""
import resource
from quasiharmonic.io import OutputError, write_whole
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    write_whole({str(path)!r}, b"x" * 1_000_000)
except OutputError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.startswith(f"cannot write {path}: ")
    assert left_in(tmp_path) == ["file"]
    assert path.read_bytes() == b"old"


@pytest.mark.long
@posix
def test_kill_9_leaves_the_complete_old_or_new_file(tmp_path):
    path = tmp_path / "mesh.obj"
    script = f"""
import numpy as np
from quasiharmonic.io import MeshData, write_map
F = np.arange(3 * 3000).reshape(-1, 3)
mesh = MeshData(np.ones((9000, 3)), F)
print("ready", flush=True)
for k in range(10**9):
    write_map({str(path)!r}, mesh, np.full((9000, 2), k + 1 / 3))
"""
    io.write_map(path, MeshData(np.ones((9000, 3)), [[0, 1, 2]]), np.zeros((9000, 2)))
    rng = np.random.default_rng()
    for _ in range(5):
        with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as process:
            assert process.stdout.readline() == b"ready\n"
            time.sleep(rng.uniform(0, 0.15))
            process.send_signal(signal.SIGKILL)
        mesh = io.read_mesh(path)
        assert len(mesh.F) in (1, 3000)
        assert mesh.vt.shape == (9000, 2)
        assert np.all(mesh.vt == mesh.vt[0, 0])
