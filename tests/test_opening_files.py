"""Files that cannot be opened, other suffixes, malicious files, and files of numbers."""

import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshData, MeshFileError
from quasiharmonic.io.untrusted import read_rows
from shared.obj_files import SQUARE

posix = pytest.mark.skipif(os.name != "posix", reason="needs POSIX")


def test_files_that_cannot_be_opened(tmp_path):
    with pytest.raises(MeshFileError, match="there is no such file"):
        io.read_mesh(tmp_path / "none.obj")
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(MeshFileError, match="is a directory"):
        io.read_mesh(tmp_path / "folder.obj")
    with pytest.raises(MeshFileError, match="is not a file name"):
        io.read_mesh("a\0b.obj")
    # Windows says of such a name that there is no such file.
    with pytest.raises(MeshFileError, match=r"cannot be read|there is no such file"):
        io.read_mesh("x" * 5000 + ".obj")


@posix
def test_reading_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.obj")
    with pytest.raises(MeshFileError, match="not a regular file"):
        io.read_mesh(tmp_path / "pipe.obj")


@pytest.mark.parametrize("name", ["mesh.3ds", "mesh", ".obj", "mesh.obj.gz"])
def test_unsupported_suffixes(tmp_path, name):
    mesh = MeshData([[0, 0], [1, 0], [0, 1]], [[0, 1, 2]])
    with pytest.raises(MeshFileError, match=r"supported: \.obj, \.off"):
        io.read_mesh(tmp_path / name)
    with pytest.raises(MeshFileError, match=r"supported: \.obj, \.off"):
        io.write_map(tmp_path / name, mesh, mesh.V[:, :2])
    with pytest.raises(MeshFileError, match=r"supported: \.obj, \.off"):
        io.check_output(tmp_path / name)


def test_suffixes_in_capitals(put):
    assert len(io.read_mesh(put(SQUARE + "f 1 2 3\n", "MESH.OBJ")).V) == 4


def test_errors_can_be_pickled_and_contain_odd_names():
    error = pickle.loads(pickle.dumps(MeshFileError("a.obj", "what", 3, "then")))
    assert (str(error), error.line) == ("a.obj: what at line 3; then", 3)
    assert str(MeshFileError("\udcff.obj", "what")).encode() == b"\\udcff.obj: what"


@pytest.mark.long
@posix
def test_memory_stays_bounded_for_malicious_files(tmp_path):
    # Long lines, which would need many times their size if split into tokens, and indices and counts that would
    # allocate an array of their size.
    script = f"""
import resource
from quasiharmonic.io import MeshFileError, read_handles, read_mesh
with open("/proc/self/statm") as file:
    now = int(file.read().split()[0]) * resource.getpagesize()
def read(text, name, megabytes):
    resource.setrlimit(resource.RLIMIT_AS, (now + megabytes * 2**20, resource.RLIM_INFINITY))
    path = {str(tmp_path / "hostile")!r} + name
    with open(path, "wb") as file:
        file.write(text)
    del text
    try:
        read_handles(path, 5) if name == ".txt" else read_mesh(path)
    except MeshFileError as error:
        print(error)
read(b"v 0 0 0\\nf " + b"1 " * 20_000_000 + b"\\n", ".obj", 280)
for head, name in ((b"v ", ".obj"), (b"v 0 0 0\\nvt ", ".obj"), (b"OFF ", ".off"), (b"", ".txt")):
    read(head + b"1 " * 4_000_000 + b"\\n", name, 120)
for index in (b"2147483648", b"-2147483648", b"999999999999999999"):
    read(b"v 0 0 0\\nf 1 1 " + index + b"\\n", ".obj", 100)
    read(b"OFF\\n1 1 0\\n0 0 0\\n3 0 0 " + index + b"\\n", ".off", 100)
    read(b"OFF\\n" + index + b" 1 0\\n0 0 0\\n", ".off", 100)
    read(index, ".txt", 100)
"""
    if not Path("/proc/self/statm").exists():
        pytest.skip("needs /proc")
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 5 + 12


@pytest.mark.slow
def test_import_is_light():
    script = "import sys, quasiharmonic.io; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert not {"numpy", "scipy", "matplotlib", "meshio", "trimesh"} & set(done.stdout.split())
    script = "import sys; from quasiharmonic.io import *; print(*sorted({m.split('.')[0] for m in sys.modules}))"
    done = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True)
    assert "numpy" in done.stdout.split()
    assert not {"scipy", "matplotlib", "meshio", "trimesh"} & set(done.stdout.split())


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("1,2.5,-3e-2\n", [[1, 2.5, -0.03]]),
        ("1 2.5\t-.03\r\n2 1. +4\n", [[1, 2.5, -0.03], [2, 1, 4]]),
        ("1;2,5;-0,03\n", [[1, 2.5, -0.03]]),
        ("vertex,x,y\n# a comment\n\n1,2.5D0,-3d-02 # another\n", [[1, 2.5, -0.03]]),
        ("\ufeffvertex;x;y\n1; 2,5; -3,0E-2\n", [[1, 2.5, -0.03]]),
    ],
)
def test_rows_of_numbers_in_every_usual_notation(tmp_path, text, rows):
    path = tmp_path / "rows.csv"
    path.write_text(text, encoding="utf-8", newline="")
    assert [values for _, values in read_rows(path, 3)] == rows


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2\n", "not 3 numbers: '1,2' at line 1"),
        ("1,2,3\n1,2,3,4\n", "not 3 numbers: '1,2,3,4' at line 2"),
        ("1,2,nan\n", "'nan' is not a finite number"),
        ("1,2,3\nx,y,z\n", "'x' is not a finite number at line 2"),
        ("1,2,1_0\n", "'1_0' is not a finite number"),
        ("1,2,3d\n", "'3d' is not a finite number"),
        ("1;2.5;3;\n", "not 3 numbers"),
        ("a b\n", "no numbers after the heading 'a b'"),
    ],
)
def test_rows_with_other_contents(tmp_path, text, words):
    path = tmp_path / "rows.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MeshFileError, match=re.escape(words)):
        read_rows(path, 3)
