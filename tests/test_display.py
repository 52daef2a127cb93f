"""Displays of results in notebooks and consoles, and figures that appear without a call."""

from __future__ import annotations

import base64
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

import quasiharmonic
from quasiharmonic import (
    Diagnosis,
    MapResult,
    Problem,
    Status,
    boundary_loops,
    certify,
    diagnose,
    distortion,
    flatten,
    harmonise,
    keep_distances,
    plot,
    polish,
    solve,
)
from quasiharmonic.results import Step
from quasiharmonic.surfaces import disk
from quasiharmonic.ui.cli import main
from quasiharmonic.ui.display import MAX_TRIANGLES, html

PLANE, F = disk(4)
V = np.column_stack([PLANE, PLANE[:, 0] * PLANE[:, 1]])
(LOOP,) = boundary_loops(F, len(V))
BEAN = PLANE[LOOP] * (1 + 0.4 * PLANE[LOOP, :1])
PROBLEM = Problem(V, F, LOOP, BEAN)
RESULT = solve(PROBLEM, polish="mips")
CROSSED = PROBLEM.with_target(np.concatenate([BEAN[:6][::-1], BEAN[6:]]))
DIAGNOSIS = diagnose(CROSSED)
FAILED = certify(F, np.where(np.arange(len(V))[:, None] == 0, 3.0, RESULT.uv))
SHOWN = [PROBLEM, RESULT, RESULT.certificate, distortion(V, F, RESULT), DIAGNOSIS, FAILED]


class Reader(HTMLParser):
    """Record tags, opened and closed in order, the text between them, and the pictures."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.pictures = [], [], []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        if tag == "img":
            self.pictures.append(dict(attributes))
        else:
            self.open.append(tag)

    handle_startendtag = handle_starttag

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def picture(text):
    """Return the only picture of a page, (h, w, 3) float64."""
    (one,) = Reader(text).pictures
    assert one["alt"]
    data = one["src"].removeprefix("data:image/png;base64,")
    return np.asarray(Image.open(BytesIO(base64.b64decode(data))).convert("RGB")) / 255.0


def reds(image):
    return int(((image[..., 0] > 0.8) & (image[..., 1] < 0.25)).sum())


@pytest.mark.slow
@pytest.mark.parametrize("shown", SHOWN, ids=lambda shown: type(shown).__name__)
def test_repr_summary_and_picture(shown):
    assert re.fullmatch(r"<\w+: [^\n]+>", repr(shown))
    assert len(repr(shown)) < 200
    assert 30 < len(shown.summary()) < 3000
    text = html(shown)
    assert len(text) < 150_000
    words = "".join(Reader(text).words)
    assert type(shown).__name__ in words
    assert shown.summary() in words
    image = picture(text)
    assert min(image.shape[:2]) >= 300
    assert image.std() > 0.05
    # Exactly obstructions and inverted triangles are red.
    assert (reds(image) > 20) == (shown in (DIAGNOSIS, FAILED))
    assert len(pickle.dumps(shown)) < 200_000


@pytest.mark.slow
def test_display_methods_of_notebooks():
    assert RESULT._repr_html_() == html(RESULT)
    assert repr(RESULT) == f"<MapResult: {RESULT.short_repr()}>"
    assert "injective and bijective, 96 triangles" in repr(RESULT)
    assert repr(DIAGNOSIS).startswith("<Diagnosis: no injective map: 1 × ")
    assert repr(diagnose(PROBLEM)) == "<Diagnosis: no known obstruction>"
    assert repr(FAILED) == f"<Certificate: not injective, {len(FAILED.inverted)} of 96 triangles not positive>"
    assert repr(certify(F, RESULT, boundary=False)) == "<Certificate: injective, 96 triangles>"


def test_summary_of_all_measures_contains_each_summary():
    found = distortion(V, F, RESULT)
    rows = {line.split()[0]: line.split()[1:] for line in found.summary().splitlines()[1:]}
    for name in ("isometric", "mips", "area_ratio"):
        one = found.statistics(name)
        assert [float(number) for number in rows[name]] == pytest.approx([one.median, one.p95, one.maximum], rel=1e-3)


@pytest.mark.slow
def test_everything_is_escaped():
    """Names come from callers, for example of an energy's class or a stage."""
    stage = replace(RESULT.stages[0], name="<script>alert('&')</script>")
    text = html(replace(RESULT, stages=[stage]))
    assert "<script" not in text
    assert stage.name in "".join(Reader(text).words)


def test_a_display_never_fails(monkeypatch):
    for shown in (
        Diagnosis(()),
        replace(RESULT, V=None),
        certify([], np.empty((0, 2))),
        certify(F, np.full(V.shape, np.nan)[:, :2]),
    ):
        text = html(shown)
        assert not Reader(text).pictures
    assert "no picture: uv is not finite" in text
    monkeypatch.setattr("quasiharmonic.ui.display.MAX_TRIANGLES", 10)
    assert "96 triangles: call .plot() to draw them" in html(RESULT)
    assert MAX_TRIANGLES > 100_000


@pytest.mark.parametrize("make", [
    lambda: RESULT,
    lambda: polish(V, F, RESULT, fixed=LOOP, max_iterations=1),
    lambda: harmonise(V, F, RESULT, fixed=LOOP, max_iterations=1),
    lambda: flatten(V, F, max_iterations=1),
    lambda: flatten(V, F, max_iterations=1, fixed=[0], target=[[0, 0]]),
    lambda: keep_distances(V, F, RESULT, max_iterations=1),
])  # fmt: skip
def test_every_result_stores_its_surface(make):
    result = make()
    np.testing.assert_array_equal(result.V, V)
    np.testing.assert_array_equal(result.F, F)
    np.testing.assert_array_equal(result.certificate.uv, result.uv)


def test_a_certificate_copies_its_arrays():
    triangles, uv = F.copy(), RESULT.uv.copy()
    certificate = certify(triangles, uv)
    triangles[:], uv[:] = 0, 0
    np.testing.assert_array_equal(certificate.F, F)
    np.testing.assert_array_equal(certificate.uv, RESULT.uv)
    assert not pickle.loads(pickle.dumps(certificate)).uv.flags.writeable


@pytest.mark.long
@pytest.mark.parametrize("kind", ["map", "distortion", "texture", "convergence"])
def test_every_kind_of_plot_of_a_result(kind):
    figure = RESULT.plot(kind)
    image = np.asarray(Image.open(BytesIO(figure._repr_png_())).convert("L"))
    assert image.shape[1] >= 800
    assert image.std() > 5


def test_plots_report_errors():
    with pytest.raises(ValueError, match="kind must be one of map, distortion, texture, convergence, not 'maps'"):
        RESULT.plot("maps")
    with pytest.raises(ValueError, match="measure must be one of"):
        RESULT.plot("distortion", measure="stretch")
    with pytest.raises(ValueError, match="the result has no surface"):
        replace(RESULT, V=None).plot()
    with pytest.raises(ValueError, match="has no problem to draw"):
        Diagnosis(()).plot()
    with pytest.raises(ValueError, match="no history"):
        replace(RESULT, history=[]).plot("convergence")


def test_convergence_plot_has_every_iteration():
    figure = RESULT.plot("convergence")
    energy, flips = figure.axes
    lines = [line.get_xydata() for line in energy.lines]
    assert len(lines) == 2
    assert [line.get_label() for line in energy.lines][1] == "polish, MIPS"
    assert sum(map(len, lines)) == len(RESULT.history)
    drawn = np.concatenate(lines)
    wanted = np.array([step.energy for step in RESULT.history])
    positive = wanted > 0
    np.testing.assert_array_equal(drawn[positive, 1], wanted[positive])
    assert drawn[-1, 0] == RESULT.n_iterations
    assert np.concatenate([line.get_ydata() for line in flips.lines]).tolist() == [s.inverted for s in RESULT.history]


def test_convergence_plot_without_finite_values():
    history = [Step(0, 3, float("inf")), Step(1, 0, 0.0)]
    result = MapResult(RESULT.uv, Status.INJECTIVE, RESULT.certificate, history=history)
    assert np.isnan(plot.plot_convergence(result).axes[0].lines[0].get_ydata()).all()


def test_a_problem_is_drawn_with_pins_and_marked_triangles():
    inner = np.setdiff1d(np.arange(len(V)), LOOP)[:2]
    figure = plot.plot_problem(V, F, [*LOOP, *inner], [*BEAN, [0, 0], [0.1, 0]], vertices=LOOP[:3], edges=[LOOP[:2]])
    pins, red = (line.get_xydata() for line in figure.axes[1].lines)
    np.testing.assert_array_equal(pins, [[0, 0], [0.1, 0]])
    np.testing.assert_array_equal(red, BEAN[:3])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".png"])
def test_the_file_suffix_determines_the_format_of_figures(tmp_path, suffix):
    paths = [tmp_path / f"{name}{suffix.upper() if name == 'b' else suffix}" for name in "ab"]
    for path in paths:
        plot.save_map_figure(path, V, F, RESULT)
    one, other = (path.read_bytes() for path in paths)
    assert one == other
    assert one.startswith({".svg": b"<?xml", ".pdf": b"%PDF", ".png": b"\x89PNG"}[suffix])
    if suffix == ".svg":
        assert one.count(b"<path") > 2 * len(F)


@pytest.mark.slow
def test_many_triangles_are_rasterised_in_vector_graphics(tmp_path):
    points, triangles = disk(42)
    plot.save_map_figure(tmp_path / "many.svg", points, triangles, points)
    text = (tmp_path / "many.svg").read_bytes()
    assert len(triangles) > 10_000
    assert text.count(b"<image") == 2
    assert len(text) < 3_000_000


@pytest.mark.slow
def test_other_suffixes_are_rejected(tmp_path, capsys):
    with pytest.raises(ValueError, match=r"pictures are written as \.png, \.svg, \.pdf"):
        plot.save_map_figure(tmp_path / "map.jpg", V, F, RESULT)
    assert main(["plot", "map.obj", "-o", str(tmp_path / "map.jpg")]) == 2
    assert "pictures are written as .png, .svg, .pdf" in capsys.readouterr().err


def test_dir_lists_public_names_only():
    names = dir(quasiharmonic)
    assert set(quasiharmonic.__all__) <= set(names)
    assert not [name for name in names if name.startswith("_") and name != "__version__"]
    for name in names:
        getattr(quasiharmonic, name)
    assert names == dir(quasiharmonic), "nothing is added by what was imported"
    with pytest.raises(AttributeError):
        quasiharmonic.arrays_of_nothing  # noqa: B018


@pytest.mark.long
def test_matplotlib_is_imported_only_for_plots():
    """Neither the package nor a search imports matplotlib; only plots do, and none imports its window."""
    code = """
import sys
import quasiharmonic
assert "numpy" not in sys.modules
from quasiharmonic.surfaces import disk
result = quasiharmonic.flatten(*disk(2))
repr(result), result.summary()
assert not {"matplotlib", "quasiharmonic.plot", "quasiharmonic.ui.display"} & {*sys.modules}
import quasiharmonic.plot
assert "matplotlib" not in sys.modules
quasiharmonic.plot.plot_map(*disk(2), disk(2)[0])
assert "<img" in result._repr_html_()
assert "matplotlib.pyplot" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
