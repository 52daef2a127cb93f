"""Wrong calls of the command line and of functions: the usage of the subcommand, and the nearest name."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import flatten, unwrap
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main

V, F = disk(3)


@pytest.mark.parametrize(
    ("words", "usage", "message"),
    [
        ("flatten a.obj -o b.obj --units-square", "usage: qhm flatten", "--units-square; did you mean --unit-square?"),
        ("unwrap a.obj -o b.obj --resolutoin=5", "usage: qhm unwrap", "--resolutoin=5; did you mean --resolution?"),
        ("unwrap a.obj -o b.obj c.obj", "usage: qhm unwrap", "unrecognized arguments: c.obj\n"),
        ("unwarp a.obj", "usage: qhm", "; did you mean unwrap?"),
        ("map a.obj --polish mipz -o b.obj", "usage: qhm map", "; did you mean mips?"),
        ("unwrap a.obj --resolution abc -o b.obj", "usage: qhm unwrap", "abc is neither N nor WIDTHxHEIGHT, such as"),
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


def test_a_folder_that_is_missing(capsys, tmp_path):
    assert main(["animate", str(tmp_path / "a.obj"), str(tmp_path / "frames"), "-o", str(tmp_path / "b.gif")]) == 2
    assert "there is no such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda: unwrap(V, F, max_strech=2), TypeError, "'max_strech'; did you mean max_stretch\\?"),
        (lambda: unwrap(V, F, up="zz"), ValueError, "not 'zz'; did you mean z\\?"),
        (lambda: unwrap(V, F, quite_different=2), TypeError, "'quite_different'$"),
        (lambda: flatten(V, np.vstack([F[:1, ::-1], F[1:]])), ValueError, "with clean, or use unwrap"),
    ],
)
def test_wrong_names(call, kind, message):
    with pytest.raises(kind, match=message):
        call()
