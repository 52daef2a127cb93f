"""Messages and output files of the command for faulty files, folders and streams."""

from __future__ import annotations

import errno
import os
import subprocess
import sys

import numpy as np
import pytest

from quasiharmonic import flatten, io, polish
from quasiharmonic.geometry.mesh.topology import boundary_loops
from quasiharmonic.io import MeshData, MeshFileError, OutputError
from quasiharmonic.surfaces import disk
from shared.commands import run
from shared.gltf_files import square

posix = pytest.mark.skipif(os.name != "posix", reason="closes streams by the shell")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory that contains only a mesh with a map."""
    monkeypatch.chdir(tmp_path)
    V, F = disk(3)
    io.write_obj("m.obj", MeshData(V, F).with_map(V))
    return tmp_path


@pytest.fixture
def full_disk(monkeypatch):
    """Make writing fail after a given number of files."""

    def set_full(after=0):
        left = iter(range(after))

        def fsync(number):
            if next(left, None) is None:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "fsync", fsync)

    return set_full


# --- folders and files of a command that fails ------------------------------------------------------------------------


def frames(folder, count):
    V, _ = disk(3)
    np.save(folder / "frames.npy", np.stack([V * (1 + 0.01 * k) for k in range(count)]))
    return folder / "frames.npy"


def left(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("call", "after"),
    [
        ("demo -o new/D", 0),
        ("animate m.obj frames.npy -o new/D", 0),
        ("batch . --to disk -o new/D", 0),
        *(("map m.obj -o o.obj --texture checkerboard", k) for k in range(3)),
        *(("refine m.obj -o o.obj", k) for k in range(3)),
    ],
)
def test_a_full_disk_leaves_nothing_behind(folder, full_disk, capsys, call, after):
    frames(folder, 2)
    before = left(folder)
    full_disk(after)
    assert run(*call.split()) == 2
    assert os.strerror(errno.ENOSPC) in capsys.readouterr().err
    assert left(folder) == before


def test_an_existing_folder_is_not_removed(folder, full_disk, capsys):
    frames(folder, 1)
    (folder / "D").mkdir()
    full_disk()
    assert run("animate", "m.obj", "frames.npy", "-o", "D") == 2
    assert left(folder) == ["D", "frames.npy", "m.obj"]


def test_written_frames_are_reported(folder, full_disk, capsys):
    frames(folder, 3)
    full_disk(2)
    assert run("animate", "m.obj", "frames.npy", "-o", "D") == 3
    assert "0000.obj is written" in capsys.readouterr().err
    assert left(folder / "D") == ["0000.obj", "0001.obj"]


def test_a_folder_that_cannot_be_created(folder, capsys):
    (folder / "file").write_text("")
    for call in ("demo -o file/D", "demo -o file"):
        assert run(*call.split()) == 2
        assert "cannot create the folder file" in capsys.readouterr().err
    assert left(folder) == ["file", "m.obj"]


# --- messages ---------------------------------------------------------------------------------------------------------

REPRESENTATIONS = "Path(", "Error(", "errno", "Errno", "object at 0x", "np.float64(", "<class"


def test_outputs_with_unusable_names(folder, capsys):
    names = ["a\0b.obj"]
    if os.name == "posix":
        os.symlink("loop.obj", folder / "loop.obj")
        names.append("loop.obj")
    for name in names:
        with pytest.raises(OutputError) as raised:
            io.check_writable(folder / name)
        said = str(raised.value)
        assert not any(word in said for word in REPRESENTATIONS)
        assert said.isprintable()


def test_inputs_with_unusable_names(folder):
    for name in ("a\0b.obj", "a\udcffb.obj", "a\nb.obj"):
        with pytest.raises(MeshFileError) as raised:
            io.read_mesh(folder / name)
        said = str(raised.value)
        assert not any(word in said for word in REPRESENTATIONS)
        assert said.isprintable()


def without(document, name):
    del document.tree["bufferViews"][0][name]
    return document


def changed(document, path, value):
    at = document.tree
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return document


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: square().gltf(uri="none.bin"), "none.bin: there is no such file"),
        (lambda: square().gltf(uri="../none.bin"), "is not in the folder of the file"),
        (lambda: without(square(), "buffer").gltf(), "an entry lacks buffer"),
        (lambda: without(square(), "byteLength").gltf(), "an entry lacks byteLength"),
        (
            lambda: changed(square(), ("bufferViews", 0, "buffer"), 9).gltf(),
            "refers to another entry that does not exist",
        ),
        (
            lambda: changed(square(), ("accessors", 0, "componentType"), 9).gltf(),
            "accessor 0 must be one of 5120",
        ),
        (lambda: changed(square(), ("accessors", 0, "componentType"), []).gltf(), "has the wrong type"),
        (lambda: changed(square(), ("meshes", 0, "primitives"), 7).gltf(), "has the wrong type"),
        (lambda: b'{"asset": {}}', "an entry lacks version"),
        (lambda: b"[1]", "has the wrong type"),
        (lambda: b"[" * 100_000, "nested too deeply"),
    ],
)
def test_damaged_gltf_is_described_in_words(folder, make, said):
    (folder / "a.gltf").write_bytes(make())
    with pytest.raises(MeshFileError, match=r"a\.gltf|none\.bin") as raised:
        io.read_mesh(folder / "a.gltf")
    assert said in str(raised.value)
    assert not any(word in str(raised.value) for word in REPRESENTATIONS)


def test_message_for_a_missing_file_has_no_error_number(folder, capsys):
    for call in ("field none.npy -o o.npy", "animate m.obj none.npy -o D", "flatten none.obj -o o.obj"):
        assert run(*call.split()) == 2
        said = capsys.readouterr().err
        assert "none." in said
        assert not any(word in said for word in REPRESENTATIONS)


@pytest.mark.parametrize("value", [object(), np.float64(-1.5), {}])
def test_wrong_arguments_are_named_briefly(value, folder):
    V, F = disk(3)
    (rim,) = boundary_loops(F, len(V))
    for call in (
        lambda: flatten(V, F, max_iterations=value),
        lambda: flatten(V, F, callback=value),
        lambda: polish(V, F, V, fixed=rim, slide=value),
        lambda: polish(V, F, V, fixed=rim, energy=value),
    ):
        with pytest.raises(ValueError, match="must be") as raised:
            call()
        assert not any(word in str(raised.value) for word in REPRESENTATIONS)


# --- options without effect ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("call", "needs"),
    [
        ("map m.obj -o o.obj --kind map", "--plot"),
        ("map m.obj -o o.obj --padding 8", "--pack"),
        ("map m.obj -o o.obj --font x", "--to"),
        ("map m.obj -o o.obj --to disk --font x", "only letter: and word:"),
        ("map m.obj -o o.obj --corner-angle 9", "--to"),
        ("map m.obj -o o.obj --corners auto", "--to"),
        ("map m.obj -o o.obj --cut", "--to"),
        ("map m.obj -o o.obj --to disk --pieces m.obj", "--slide"),
        ("flatten m.obj -o o.obj --rings 3", "--energy distances"),
        ("flatten m.obj -o o.obj --unit cm", "--pattern"),
        ("flatten m.obj -o o.obj --allowance 1", "--pattern"),
        ("polish m.obj -o o.obj --padding 8", "--pack"),
        ("polish m.obj -o o.obj --to disk", "--slide"),
        ("harmonise m.obj -o o.obj --padding 8", "--pack"),
        ("animate m.obj m.obj -o o --max-motion-ratio 2", "--polish"),
        ("animate m.obj m.obj -o o --frames-per-second 2", "--frames-per-second needs a moving picture"),
        ("measure m.obj --rings 3", "--distances"),
        ("plot m.obj -o o.png --measure mips", "--kind distortion"),
        ("plot m.obj -o o.png --kind texture --measure isometric", "--kind distortion"),
        ("plot m.obj -o o.png --kind map --texture p.png", "--kind map"),
        ("check m.obj --plot o.png", "--boundary"),
        ("check m.obj --boundary --as float64", "--as"),
        ("check m.obj --boundary --any-triangulation", "--any-triangulation"),
        ("check m.obj --boundary --fixed m.obj", "--fixed"),
        ("check m.obj --surface m.obj", "no file is a patch"),
        ("flatten m.obj -o o.obj --surface missing", "no file is a patch"),
        ("check lh.cortex.patch.3d --surface missing", "there is no such file"),
        ("batch . -o o --flatten --strategy speed", "--strategy"),
        ("batch . -o o --to disk --energy mips", "flatten"),
        ("batch . -o o --to disk --slide", "polish"),
        ("batch . -o o --corners auto", "give the outline by --to"),
    ],
)
def test_an_option_without_effect_is_rejected(folder, capsys, call, needs):
    assert run(*call.split()) == 2
    assert needs in capsys.readouterr().err
    assert left(folder) == ["m.obj"]


# --- closed streams ---------------------------------------------------------------------------------------------------


def shell(call, streams, *, unbuffered=False):
    """Return the exit status and standard error of a command with the given streams."""
    command = f"set -o pipefail; {sys.executable} -m quasiharmonic {call} {streams}"
    environment = {**os.environ, "PYTHONUNBUFFERED": "1" if unbuffered else ""}
    done = subprocess.run(["bash", "-c", command], capture_output=True, env=environment)
    return done.returncode, done.stderr.decode()


@pytest.mark.long
@posix
@pytest.mark.parametrize(
    ("call", "unbuffered"),
    [
        *((call, False) for call in ("--version", "--help", "map --help", "check m.obj", "measure m.obj")),
        *((call, True) for call in ("--help", "check m.obj")),
        *(pytest.param(call, True, marks=pytest.mark.nightly) for call in ("--version", "map --help", "measure m.obj")),
    ],
)
def test_without_a_reader_the_command_ends_without_a_message(folder, call, unbuffered):
    status, said = shell(call, "| true", unbuffered=unbuffered)
    assert status == 141
    assert said == ""


@pytest.mark.slow
@posix
@pytest.mark.parametrize("call", ["--version", "check m.obj", "check m.obj --boundary", "measure m.obj"])
def test_a_command_that_writes_no_file_ends_with_141_when_standard_output_is_closed(folder, call):
    assert shell(call, ">&-") == (141, "")


@pytest.mark.slow
@posix
@pytest.mark.parametrize("call", ["check m.obj --json out.json", "measure m.obj --export out.csv", "--help"])
def test_closed_standard_output_is_no_failure_if_the_report_goes_elsewhere(folder, call):
    status, said = shell(call, ">&-")
    assert status == 0
    assert ("usage" in said) == (call == "--help")


@pytest.mark.long
@posix
@pytest.mark.parametrize(
    ("call", "status", "streams"),
    [
        *(("check m.obj", (0, 141), streams) for streams in ("2>&-", ">&- 2>&-", "2>&1 | true")),
        *(("check none", (2,), streams) for streams in ("2>&-", ">&- 2>&-", "2>&1 | true")),
        ("--version", (0, 141), ">&- 2>&-"),
        *(pytest.param("--version", (0, 141), each, marks=pytest.mark.nightly) for each in ("2>&-", "2>&1 | true")),
    ],
)
def test_without_standard_error_the_command_ends_without_a_message(folder, call, status, streams):
    found, said = shell(call, streams)
    assert found in status
    assert said == ""


@pytest.mark.slow
@posix
def test_json_output_stays_valid_without_standard_error(folder):
    command = f"{sys.executable} -m quasiharmonic check m.obj --json - 2>&-"
    done = subprocess.run(["bash", "-c", command], stdout=subprocess.PIPE)
    assert done.returncode == 0
    assert done.stdout.count(b"\n") == 1


@pytest.mark.long
@posix
@pytest.mark.parametrize(
    ("call", "unbuffered"),
    [
        *((call, False) for call in ("--version", "--help", "check m.obj")),
        *((call, True) for call in ("--help", "check m.obj")),
        ("map --help", True),
        *(pytest.param(*case, marks=pytest.mark.nightly) for case in (("--version", True), ("map --help", False))),
    ],
)
def test_a_full_standard_output_is_reported(folder, call, unbuffered):
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full on this system")
    status, said = shell(call, "> /dev/full", unbuffered=unbuffered)
    assert status == 2
    assert os.strerror(errno.ENOSPC) in said
    assert "Traceback" not in said
