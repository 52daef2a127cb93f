"""Wrong calls of the command line and of functions: the usage of the subcommand, and the nearest name."""

from __future__ import annotations

import re

import numpy as np
import pytest

from quasiharmonic import InverseMap, boundary_loops, flatten, harmonise, injective_map, io, morph, polish, unwrap
from quasiharmonic.io import MeshData
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main

V, F = disk(3)
(RIM,) = boundary_loops(F)
SOUP = np.arange(3 * len(F)).reshape(-1, 3)
FLAT = np.column_stack([V, np.zeros(len(V))])
FOLDED = np.where(np.arange(len(V))[:, None] == 0, 3.0, V)


@pytest.mark.parametrize(
    ("words", "usage", "message"),
    [
        ("flatten a.obj -o b.obj --units-square", "usage: qhm flatten", "--units-square; did you mean --unit-square?"),
        ("unwrap a.obj -o b.obj --resolutoin=5", "usage: qhm unwrap", "--resolutoin=5; did you mean --resolution?"),
        ("unwrap a.obj -o b.obj c.obj", "usage: qhm unwrap", "unrecognized arguments: c.obj\n"),
        ("unwarp a.obj", "usage: qhm", "; did you mean unwrap?"),
        ("map a.obj --polish mipz -o b.obj", "usage: qhm map", "; did you mean mips?"),
        ("unwrap a.obj --resolution abc -o b.obj", "usage: qhm unwrap", "abc is neither N nor WIDTHxHEIGHT, such as"),
        ("polish a.obj --energy blent -o b.obj", "usage: qhm polish", "; did you mean blend?"),
        ("unwrap a.obj --resolution 0x5 -o b.obj", "usage: qhm unwrap", "0x5 is neither N nor WIDTHxHEIGHT, such as"),
    ],
)
def test_wrong_words(capsys, words, usage, message):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(usage)
    assert message in said


@pytest.mark.parametrize(
    ("to", "message"),
    [
        ("dsk", "; did you mean disk?"),
        ("letter", "; did you mean letter:G?"),
        ("star:x", "'x' is not a whole number, such as 5 in star:5"),
        ("ring:x", "'x' is not a number, such as 0.5 in ring:0.5"),
        ("star:99999999", "99999999 is too many: at most"),
    ],
)
def test_wrong_outlines(capsys, tmp_path, to, message):
    io.write_mapped(tmp_path / "a.obj", MeshData(V, F).with_map(V))
    assert main(["map", str(tmp_path / "a.obj"), "--to", to, "-o", str(tmp_path / "b.obj")]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("seams", ["file", "none"])
def test_a_soup_has_no_seams_to_ignore(capsys, tmp_path, seams):
    soup = MeshData(V[F].reshape(-1, 2), SOUP)
    io.write_mapped(tmp_path / "a.obj", soup.with_map(V[F].reshape(-1, 2)))
    assert main(["map", str(tmp_path / "a.obj"), "--to", "disk", "--seams", seams, "-o", str(tmp_path / "b.obj")]) == 0
    assert "each mapped on its own (qhm check lists vertices to weld)" in capsys.readouterr().out


def test_advice_on_a_soup_names_the_option(capsys, tmp_path):
    io.write_mapped(tmp_path / "a.ply", MeshData(V[F].reshape(-1, 2), SOUP).with_map(V[F].reshape(-1, 2)))
    assert main(["flatten", str(tmp_path / "a.ply"), "--seams", "none", "-o", str(tmp_path / "b.ply")]) == 0
    assert capsys.readouterr().err.endswith("Weld these vertices with --weld 1e-06.\n")


def test_a_folder_that_is_missing(capsys, tmp_path):
    assert main(["animate", str(tmp_path / "a.obj"), str(tmp_path / "frames"), "-o", str(tmp_path / "b.gif")]) == 2
    assert capsys.readouterr().err == f"qhm animate: {tmp_path / 'frames'}: there is no such file or folder\n"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("check x.geo", r"\.geo files cannot be read; supported: \.obj, .*\.mesh\n"),
        ("measure x.geo", r"\.geo files cannot be read; supported: \.obj, .*\.mesh\n"),
        ("plot x.geo -o p.png", r"\.geo files cannot be read; supported: \.obj, .*\.mesh, \.npy, .*"),
        ("measure .", "is a folder, not a file; supported: .*"),
    ],
)
def test_files_of_no_format(capsys, tmp_path, monkeypatch, call, message):
    monkeypatch.chdir(tmp_path)
    assert main(call.split()) == 2
    assert re.search(f": {message}", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda: unwrap(V, F, max_strech=2), TypeError, "'max_strech'; did you mean max_stretch\\?"),
        (lambda: unwrap(V, F, up="zz"), ValueError, "not 'zz'; did you mean z\\?"),
        (lambda: unwrap(V, F, quite_different=2), TypeError, "'quite_different'$"),
        (lambda: polish(V, F, V, energy="mip"), ValueError, "use harmonise for .*; did you mean mips\\?"),
        (lambda: harmonise(V, F, V, energy="spring"), ValueError, "; did you mean springs\\?"),
        (lambda: injective_map(V, F, RIM, V[RIM], strategy="spede"), ValueError, "; did you mean speed\\?"),
        (lambda: injective_map(V[F].reshape(-1, 2), SOUP, RIM, V[RIM]), ValueError, "weld them first with clean"),
        (
            lambda: morph(FLAT, F, [0], [[0, 0]]),
            ValueError,
            r"pass points\[:, :2\]; tetrahedra need F of shape \(f, 4\)",
        ),
        (lambda: injective_map(V, F, RIM, V[RIM], start=FLAT), ValueError, r"pass start\[:, :2\]"),
        (lambda: flatten(V, np.vstack([F, [0, 0, 1]])), ValueError, "remove such triangles with clean"),
        (lambda: flatten(V, np.vstack([F, F[:1]])), ValueError, r"\(a polygon .*remove repetitions with clean"),
        (lambda: polish(V, F, FOLDED), ValueError, "repair it first"),
        (lambda: harmonise(V, F, FOLDED, energy="mips"), ValueError, "repair the map first"),
        (lambda: InverseMap(V, F, FOLDED), ValueError, "Repair it first"),
        (lambda: flatten(V, np.vstack([F[:1, ::-1], F[1:]])), ValueError, "with clean, or use unwrap"),
    ],
)
def test_wrong_names(call, kind, message):
    with pytest.raises(kind, match=message):
        call()


def test_a_reversed_target():
    said = injective_map(V, F, RIM, V[RIM[::-1]]).summary()
    assert "Check that fixed and target are in the same order, and try target[::-1]." in said
    assert injective_map(V, F, RIM, V[RIM[::-1]][::-1]).success
