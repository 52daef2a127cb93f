"""Messages of the command line name options, not keyword arguments of functions."""

from __future__ import annotations

import contextlib
import re

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.io import MeshData
from quasiharmonic.surfaces import disk, starfish
from quasiharmonic.ui.cli import COMMANDS, parser_of
from quasiharmonic.ui.cli.report import in_options, list_options, use_options
from shared.commands import run


def destinations():
    """The names of the options of all subcommands, as Python spells them."""
    parser = parser_of(COMMANDS)
    return {name for command in COMMANDS for name in list_options(parser, command)}


def keyword_spellings(text):
    """Words that only Python users know: ``name=value``, names with an underscore, "omit name"."""
    names = "|".join(sorted(destinations(), key=len, reverse=True))
    underscored = "|".join(name for name in destinations() if "_" in name)
    patterns = rf"(?<![\w/.-])(?:{names})=\S", rf"(?<![\w/.-])(?:{underscored})\b", rf"\b(?:omit|by) (?:{names})\b"
    return [found for pattern in patterns for found in re.findall(pattern, text)]


def test_the_check_finds_keyword_spellings():
    for text in ("resolution=101 suffices", "Raise max_stretch", "give the outline by to", "omit fixed and weights"):
        assert keyword_spellings(text)
    assert not keyword_spellings("--resolution 101 suffices, see /tmp/max_stretch=2.obj")


def test_options_replace_keyword_arguments():
    use_options(parser_of(["unwrap"]), "unwrap")
    assert in_options("resolution=101 suffices") == "--resolution 101 suffices"
    assert in_options("Raise max_stretch, or max_charts if it was given.") == (
        "Raise --max-stretch, or --max-charts if it was given."
    )
    assert in_options("/tmp/max_stretch.obj: V, max_angle=3") == "/tmp/max_stretch.obj: V, max_angle=3"
    use_options(parser_of(["flatten"]), "flatten")
    assert in_options("omit unit_square or islands") == "omit --unit-square or --islands"
    assert in_options("omit fixed, weights and start: they end") == "omit --fixed, --weights and --start: they end"
    assert in_options("cut=True") == "--cut"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a surface, a map with an inverted triangle, islands, a closed surface and a list of vertices."""
    monkeypatch.chdir(tmp_path)
    V, F = disk(3)
    io.write_mapped("map.obj", MeshData(V, F).with_map(V))
    folded = V.copy()
    folded[0] = 3
    io.write_mapped("folded.obj", MeshData(V, F).with_map(folded))
    closed, triangles = starfish(3, 4)
    lines = ["v {!r} {!r} {!r}\n".format(*point) for point in closed.tolist()]
    lines += ["f {} {} {}\n".format(*row) for row in (triangles + 1).tolist()]
    (tmp_path / "closed.obj").write_text("".join(lines))
    (tmp_path / "few.txt").write_text("1\n2\n")
    (tmp_path / "weights.txt").write_text("1\n-1\n")
    np.save("field.npy", np.full((4, 4, 2), np.nan))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    "call",
    [
        "unwrap closed.obj -o o.obj --resolution 8 --padding 4",
        "unwrap closed.obj -o o.obj --resolution 64 --texels-per-unit 100000",
        "unwrap closed.obj -o o.obj --texels-per-unit 1e300",
        "unwrap closed.obj -o o.obj --texels-per-unit 1e-300",
        "unwrap closed.obj -o o.obj --max-stretch 1.01 --max-charts 1",
        "unwrap closed.obj -o o.obj --max-stretch 0.5",
        "unwrap map.obj -o o.obj --keep-seams --max-stretch nan",
        "flatten closed.obj -o o.obj",
        "flatten map.obj -o o.obj --fixed few.txt --unit-square",
        "flatten map.obj -o o.obj --weights weights.txt",
        "flatten map.obj -o o.obj --islands 0 --unit-square",
        "flatten map.obj -o o.obj --energy distances --weights weights.txt",
        "flatten folded.obj -o o.obj --start",
        "flatten map.obj -o o.obj --pack --padding 5000",
        "polish folded.obj -o o.obj",
        "polish folded.obj -o o.obj --free",
        "polish map.obj -o o.obj --free --fixed few.txt",
        "polish map.obj -o o.obj --fixed few.txt",
        "polish map.obj -o o.obj --slide --to square",
        "polish map.obj -o o.obj --islands 7",
        "harmonise folded.obj -o o.obj",
        "harmonise map.obj -o o.obj --fixed few.txt",
        "map closed.obj -o o.obj",
        "map map.obj -o o.obj --to disk --refine --max-iterations 1",
        "map map.obj -o o.obj --fixed few.txt",
        "map map.obj -o o.obj --to star:5 --polish mips --slide --corner-angle 400",
        "repair map.obj -o o.obj --fixed missing.txt",
        "check map.obj --fixed missing.txt",
        "check folded.obj --fixed few.txt",
        "measure closed.obj",
        "animate map.obj folded.obj -o o --polish mips --max-motion-ratio -1",
        "batch . -o out --corners auto",
        "batch . -o out --to disk --slide",
        "batch . -o out --flatten --to disk",
        "field field.npy -o o.npy",
        "transfer map.obj folded.obj -o o.obj",
    ],
)
def test_messages_spell_no_keyword_arguments(folder, capsys, call):
    with contextlib.suppress(SystemExit):
        run(*call.split())
    out, err = capsys.readouterr()
    said = "\n".join(line for line in (out + err).splitlines() if not line.startswith("usage"))
    assert said
    assert keyword_spellings(said) == []
    # A file is named once at the beginning of a message.
    assert not re.search(r"(\S+\.(?:obj|txt|npy)): \1", said)
