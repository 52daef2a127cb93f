"""Outlines of flat maps, read from the drawings: true to scale, with the requested seam allowance."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from quasiharmonic import surfaces, write_pattern
from quasiharmonic.apps.flattening.patterns import UNITS, pattern
from quasiharmonic.io import OutputError

SVG = "{http://www.w3.org/2000/svg}"


def area(loop):
    x, y = (loop - loop.mean(axis=0)).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def length(loop):
    return float(np.hypot(*(np.roll(loop, -1, axis=0) - loop).T).sum())


def distances(points, loop):
    """Return distances from points to a closed polygon, for arrays of both."""
    tail, side = loop, np.roll(loop, -1, axis=0) - loop
    apart = points[:, None] - tail[None]
    s = np.clip((apart * side).sum(axis=2) / (side**2).sum(axis=1), 0, 1)
    return np.linalg.norm(apart - s[..., None] * side, axis=2).min(axis=1)


def drawn(path):
    """Return the size on paper, the size of the drawing, and the closed lines of each group, with y upwards."""
    root = ET.fromstring(path.read_bytes())
    paper = [re.fullmatch(r"(.*)mm", root.get(side)).group(1) for side in ("width", "height")]
    groups = {}
    for group in root.iter(f"{SVG}g"):
        for line in group.iter(f"{SVG}path"):
            shape = re.fullmatch(r"M(.*) Z", line.get("d")).group(1)
            points = np.array([[float(x) for x in point.split()] for point in shape.split(" L")])
            groups.setdefault(group.get("id"), []).append(points * [1, -1])
    return np.array(paper, dtype=float), np.array(root.get("viewBox").split(), dtype=float), groups


@pytest.fixture
def ring():
    """A square ring of 2 by 2 with a hole of 1 by 1."""
    return surfaces.annulus(6)


@pytest.mark.parametrize("unit", UNITS)
def test_drawing_is_true_to_scale(ring, tmp_path, unit):
    V, F = ring
    write_pattern(tmp_path / "ring.svg", F, 1000 + V, unit=unit)
    paper, box, groups = drawn(tmp_path / "ring.svg")
    assert np.array_equal(box, [0, 0, *paper])
    assert np.allclose(paper, 2 * UNITS[unit] + 10, rtol=1e-12)
    assert list(groups) == ["cut"]
    outer, hole = groups["cut"]
    assert area(outer) == pytest.approx(4 * UNITS[unit] ** 2, rel=1e-12)
    assert length(outer) == pytest.approx(8 * UNITS[unit], rel=1e-12)
    assert area(hole) == pytest.approx(-area(outer) / 4, rel=1e-12)
    for loop in (outer, hole):
        assert (loop * [1, -1] >= 0).all()
        assert (loop * [1, -1] <= paper).all()


@pytest.mark.long
def test_dxf_is_true_to_scale_and_deterministic(ring, tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    pytest.importorskip("shapely")
    V, F = ring
    for name in ("one.dxf", "other.dxf"):
        write_pattern(tmp_path / name, F, V / 3, unit="in", allowance=0.1)
    assert (tmp_path / "one.dxf").read_bytes() == (tmp_path / "other.dxf").read_bytes()
    drawing = ezdxf.readfile(tmp_path / "one.dxf")
    assert drawing.units == ezdxf.units.MM
    lines = {layer: [line for line in drawing.modelspace() if line.dxf.layer == layer] for layer in ("CUT", "SEAM")}
    assert len(drawing.modelspace()) == sum(map(len, lines.values()))
    assert all(line.closed for line in drawing.modelspace())
    wanted = pattern(F, V / 3, unit="in", allowance=0.1)
    for layer, loops in (("CUT", wanted.cut), ("SEAM", wanted.seam)):
        for line, loop in zip(lines[layer], loops, strict=True):
            assert np.allclose(np.array(line.get_points("xy")), loop, rtol=1e-14, atol=1e-14)
    assert sorted(area(loop) for loop in wanted.seam) == pytest.approx([-(25.4**2) / 9, 25.4**2 * 4 / 9], rel=1e-12)


def test_the_cut_line_is_at_the_distance_of_the_allowance(ring):
    pytest.importorskip("shapely")
    V, F = ring
    turn = 0.7 * (V**2).sum(axis=1)
    w = (V @ (1, 1j)) * np.exp(0.2j * turn) * 40
    uv = np.stack([w.real, w.imag], axis=1)
    found = pattern(F, uv, allowance=4.0)
    assert len(found.cut) == len(found.seam) == 2
    for cut in found.cut:
        ends = np.array([distances(cut, seam) for seam in found.seam]).min(axis=0)
        assert np.allclose(ends, 4.0, rtol=1e-9)
        # Between its corners it is closer by almost nothing.
        middle = np.array([distances((cut + np.roll(cut, -1, axis=0)) / 2, seam) for seam in found.seam]).min(axis=0)
        assert middle.min() > 4 * (1 - 4e-4)
        assert middle.max() < 4 * (1 + 1e-9)
    # The outer line is longer than its seam by at least a full circle around the allowance; the hole's is shorter.
    outer, hole = (max(found.cut, key=area), min(found.cut, key=area))
    assert area(outer) > area(max(found.seam, key=area)) > 0 > area(hole) > area(min(found.seam, key=area))


def test_allowance_of_a_square_has_the_expected_area():
    pytest.importorskip("shapely")
    V, F = surfaces.grid(3, 3)
    found = pattern(F, 100 * V, allowance=10.0)
    quarter = 32
    disk = 4 * quarter * 0.5 * 10.0**2 * np.sin(np.pi / 2 / quarter)
    assert area(found.cut[0]) == pytest.approx(100**2 + 4 * 100 * 10 + disk, rel=1e-12)


def test_narrow_holes_vanish_in_the_allowance(ring):
    pytest.importorskip("shapely")
    V, F = ring
    assert len(pattern(F, V, allowance=0.51).cut) == 1
    assert len(pattern(F, V, allowance=0.49).cut) == 2


def test_pieces_keep_a_distance_for_their_allowances(tmp_path):
    pytest.importorskip("shapely")
    V, F = surfaces.grid(2, 2)
    uv, both = np.concatenate([V, V + np.array([1.5, 0])]), np.concatenate([F, F + len(V)])
    assert len(pattern(both, uv, allowance=0.24).cut) == 2
    with pytest.raises(ValueError, match="overlap: place them farther apart"):
        pattern(both, uv, allowance=0.26)
    with pytest.raises(ValueError, match="overlap"):
        write_pattern(tmp_path / "none.svg", both, uv, allowance=0.26)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (1.0, {"unit": "furlong"}, "unit must be one of mm, cm, m, in, not 'furlong'"),
        (1.0, {"allowance": -1}, "allowance must be a finite number of at least 0"),
        (1.0, {"allowance": np.nan}, "allowance must be a finite number of at least 0"),
        (-1.0, {}, "overlaps itself, so its pattern cannot be cut out. Not injective"),
    ],
)
def test_unusable_patterns_are_rejected(ring, tmp_path, change, options, message):
    V, F = ring
    with pytest.raises(ValueError, match=re.escape(message)):
        write_pattern(tmp_path / "none.svg", F, V * [1, change], **options)
    assert not list(tmp_path.iterdir())


def test_file_names_determine_the_format(ring, tmp_path):
    V, F = ring
    with pytest.raises(ValueError, match=r"must be \.svg or \.dxf, not \.pdf"):
        write_pattern(tmp_path / "ring.pdf", F, V)
    with pytest.raises(ValueError, match="not without a suffix"):
        write_pattern(tmp_path / "ring", F, V)
    with pytest.raises(OutputError, match="there is no directory"):
        write_pattern(tmp_path / "nowhere" / "ring.svg", F, V)


@pytest.mark.parametrize(
    ("package", "name", "extra"), [("ezdxf", "ring.dxf", "patterns"), ("shapely", "ring.svg", "shapes")]
)
def test_missing_packages_are_named(ring, tmp_path, monkeypatch, package, name, extra):
    V, F = ring
    for loaded in [module for module in sys.modules if module.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"pip install '.*\[{extra}\]'"):
        write_pattern(tmp_path / name, F, V, allowance=0.1)
    assert not list(tmp_path.iterdir())


def test_coordinates_that_overflow_in_mm_are_rejected():
    V, F = surfaces.grid(2, 2)
    with pytest.raises(ValueError, match=r"are outside the range of doubles: check the unit m"):
        pattern(F, 1e306 * V, unit="m")
