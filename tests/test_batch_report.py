"""The report page of a run: its numbers and figures, and that it contains no scripts or external links."""

from __future__ import annotations

import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from base64 import b64decode
from html.parser import HTMLParser

import numpy as np
import pytest

from quasiharmonic import batch, io
from quasiharmonic.ui.batch import records
from quasiharmonic.ui.cli import main
from quasiharmonic.ui.report import charts, page, statistics, write_report
from quasiharmonic.ui.report.page import STYLE
from shared.datasets import star_of, write_problem, write_stars

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("quick_workers")]

VILE = '<script>alert(1)</script>"><img src=x onerror=alert(2)>&amp;\u202egnp'


class Reader(HTMLParser):
    """The tags of a page with attributes, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words = [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.words.append(data)

    @property
    def text(self):
        return " ".join(self.words)


def made(tmp_path, count=200, seed=0, name="t.csv", **more):
    """A table of synthetic records."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(count):
        good = k % 20 != 3
        rows.append(
            {
                "problem": f"{'simple' if k % 2 else 'letters'}/{k}",
                "outcome": "injective" if good else "timeout",
                "certified": good,
                "triangles": int(10 ** rng.uniform(2, 5)),
                "seconds": float(10 ** rng.uniform(-2, 1)),
                "seconds_map": 0.01,
                "mips": float(10 ** rng.uniform(-1, 2)) if good else None,
                "error": None if good else "not done within 10 s",
                **more,
            }
        )
    records.write_table(tmp_path / name, rows)
    return rows


def written(tmp_path, *arguments):
    write_report(tmp_path / "report.html", *arguments)
    return (tmp_path / "report.html").read_text()


class TestPage:
    def test_the_page_states_the_numbers_of_the_records(self, tmp_path):
        rows = made(tmp_path)
        text = Reader(written(tmp_path, tmp_path / "t.csv")).text
        good = [row for row in rows if row["certified"]]
        assert "95.0 %" in text
        assert "190 of 200 certified injective" in text
        assert f"median {page.number(float(np.median([row['mips'] for row in good])))}".capitalize() in text
        assert page.number(float(np.median([row["seconds"] for row in good])), "s") in text
        assert "190 certified injective, 10 over the time limit" in text
        assert re.search(r"letters +100 +100 +100 %", text)
        assert re.search(r"simple +100 +90 +90.0 %", text)
        assert "Failed (10)" in text
        assert text.count("over the time limit: not done within 10 s") == 10
        slowest = sorted(good, key=lambda row: -row["seconds"])[:12]
        listed = re.findall(r"(?:simple|letters)/\d+", text[text.index("Slowest") : text.index("Failed")])
        assert listed == [row["problem"] for row in slowest]

    def test_the_worst_problems_come_first(self, tmp_path):
        rows = made(tmp_path)
        for row in rows:
            row["isometric"] = None if row["mips"] is None else 2 + row["mips"]
        rows[7] |= {"isometric": 1.7e10, "mips": 2.5}
        records.write_table(tmp_path / "t.csv", rows)
        text = Reader(written(tmp_path, tmp_path / "t.csv")).text
        good = [row for row in rows if row["certified"]]
        head = text[: text.index("certified injective, 10 over")]
        stretch, mips = ([row[name] for row in good] for name in ("isometric", "mips"))
        assert rows[7]["certified"]
        assert re.search(rf"1.7·10¹⁰ +worst stretch[^;]*; median {page.number(float(np.median(stretch)))}", head)
        assert re.search(
            rf"{page.number(max(mips))} +worst MIPS[^;]*; median {page.number(float(np.median(mips)))}", head
        )
        assert head.index("worst stretch") < head.index("median time")
        lists = [text.index(words) for words in ("Highest stretch", "Highest MIPS", "Slowest")]
        assert lists == sorted(lists)
        assert re.findall(r"(?:simple|letters)/\d+", text[lists[0] :])[0] == rows[7]["problem"]
        name = rows[7]["problem"].partition("/")[0]
        assert re.search(rf"{name} +100 +\d+ [^a-z]*1.7·10¹⁰", text)

    def test_a_real_run_with_pictures(self, tmp_path):
        source = write_stars(tmp_path / "set", ["easy/a", "easy/b", "hard/c"])
        (source / "bad").mkdir()
        (source / "bad" / "input.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        batch.run(source, tmp_path / "out", jobs=1)
        assert main(["batch", "-o", str(tmp_path / "out"), "--report"]) == 0
        read = Reader((tmp_path / "out" / "report.html").read_text())
        pictures = [attributes["src"] for tag, attributes in read.tags if tag == "img"]
        # Three maps in three lists, and a surface without a map.
        assert len(pictures) == 10
        for picture in pictures:
            head, data = picture.split(",")
            assert head == "data:image/png;base64"
            assert b64decode(data).startswith(b"\x89PNG")
        assert len(set(pictures)) == 4
        assert "75.0 %" in read.text
        assert "with unusable input" in read.text
        assert str(source) in read.text

    def test_free_boundaries(self, tmp_path):
        for k in range(2):
            V, F, _, _ = star_of(3)
            (tmp_path / "set").mkdir(exist_ok=True)
            io.write_obj(tmp_path / "set" / f"{k}.obj", io.MeshData(V, F))
        (tmp_path / "set" / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
        batch.run(tmp_path / "set", tmp_path / "out", batch.Settings(flatten=True), jobs=1)
        text = Reader(written(tmp_path, tmp_path / "out")).text
        assert "2 of 3 certified bijective" in text
        assert "2 certified bijective, 1 with unusable input" in text
        assert "certified injective" not in text
        assert "Settings: flatten True" in text
        # The table alone gives the same count.
        assert "2 of 3 certified bijective" in Reader(written(tmp_path, tmp_path / "out" / "records.csv")).text

    def test_an_unfinished_run(self, tmp_path):
        source = write_stars(tmp_path / "set", ["a", "b", "c"])
        batch.run(source, tmp_path / "out", jobs=1)
        (tmp_path / "out" / "records.csv").unlink()
        (tmp_path / "out" / "results" / "c" / "record.json").unlink()
        assert "2 of 2 certified" in Reader(written(tmp_path, tmp_path / "out")).text

    def test_damaged_files_are_skipped(self, tmp_path):
        out = tmp_path / "out"
        batch.run(write_stars(tmp_path / "set", list("abcdefg")), out, jobs=1)
        (out / "records.csv").unlink()
        for name, text in {
            "a": '{"problem": "a", "outc',
            "b": "[1]",
            "c": "{}",
            "d": '{"problem": 7, "outcome": "injective"}',
            "e": '{"problem": "e", "outcome": "injective", "seconds": "long"}',
        }.items():
            (out / "results" / name / "record.json").write_text(text)
        (out / "results" / "f" / "map.obj").write_text("spoilt")
        for text in ("[]", '{"settings": 1}', "{"):
            (out / "qhm-batch.json").write_text(text)
            assert "2 of 2 certified" in Reader(written(tmp_path, out)).text
        assert batch.run(tmp_path / "set", out, jobs=1).resumed == 1

    def test_impossible_problems_are_counted_separately(self, tmp_path):
        V, F, fixed, target = star_of(4)
        write_problem(tmp_path / "set" / "mirrored", V, F, fixed, target * [1, -1])
        write_stars(tmp_path / "set", ["a"])
        batch.run(tmp_path / "set", tmp_path / "out", jobs=1)
        text = Reader(written(tmp_path, tmp_path / "out")).text
        assert "1 no injective map found; 1 proven to have no such map" in text
        assert "The target has the opposite orientation to the mesh" in text

    @pytest.mark.parametrize("columns", [["problem"], ["error"], ["outcome"], ["source", "versions"]], ids="-".join)
    def test_any_names(self, tmp_path, columns):
        made(tmp_path, 30, **dict.fromkeys(columns, VILE), certified=False)
        made(tmp_path, 30, name="x.csv")
        (tmp_path / "x.csv").rename(tmp_path / "<b>o&.csv")
        read = Reader(written(tmp_path, tmp_path / "t.csv", tmp_path / "<b>o&.csv"))
        assert not {"script", "iframe", "link", "object"} & {tag for tag, _ in read.tags}
        assert all(attributes.get("src", "data:").startswith("data:") for _, attributes in read.tags)
        assert not any(name.startswith("on") or name == "href" for _, attributes in read.tags for name in attributes)
        assert "<b>o&.csv" in read.text
        if columns[0] in ("problem", "error", "outcome"):
            assert r"<script>alert(1)</script>" in read.text
            assert r"\u202e" in read.text
            assert "\u202e" not in read.text

    def test_the_page_has_no_external_references(self, tmp_path):
        made(tmp_path)
        text = written(tmp_path, tmp_path / "t.csv")
        assert not re.search(r"https?:|//[a-z]|@import|url\(", text)
        assert "default-src 'none'" in text

    def test_sparse_records(self, tmp_path):
        """Records of other programs, with missing fields."""
        (tmp_path / "t.csv").write_text("problem,seconds\na,1\nb,0\nc,\nd,inf\n")
        text = Reader(written(tmp_path, tmp_path / "t.csv")).text
        assert "0 of 4 certified" in text
        (tmp_path / "t.csv").write_text("problem,certified\na,True\n")
        assert "1 of 1 certified" in Reader(written(tmp_path, tmp_path / "t.csv", tmp_path / "t.csv")).text
        pyarrow = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(pyarrow.table({"problem": [0, 1], "seconds": [0.5, None]}), tmp_path / "t.parquet")
        assert "0 of 2 certified" in Reader(written(tmp_path, tmp_path / "t.parquet")).text

    def test_many_failures_and_many_dots_are_limited(self, tmp_path):
        made(tmp_path, 11_000, name="many.csv")
        text = written(tmp_path, tmp_path / "many.csv", tmp_path / "many.csv")
        assert len(text) < 450_000
        assert "And 50 more" in text

    def test_errors(self, tmp_path, capsys):
        (tmp_path / "t.csv").write_text("problem,seconds\n")
        assert main(["batch", "-o", str(tmp_path / "t.csv"), "--report"]) == 2
        assert "no records" in capsys.readouterr().err
        for name in ("none.csv", "none"):
            assert main(["batch", "-o", str(tmp_path / name), "--report"]) == 2
            assert "no such folder or table of records" in capsys.readouterr().err
        assert main(["batch", "-o", str(tmp_path), "--report"]) == 2
        assert not (tmp_path / "report.html").exists()
        assert main(["batch", "-o", str(tmp_path)]) == 2
        assert "name a folder or a list of problems" in capsys.readouterr().err
        assert main(["batch", str(tmp_path), "-o", str(tmp_path / "o"), "--against", str(tmp_path / "t.csv")]) == 2
        assert "--against needs --report" in capsys.readouterr().err

    def test_a_run_writes_its_report(self, tmp_path, capsys):
        source = write_stars(tmp_path / "set", ["a"])
        assert main(["batch", str(source), "-o", str(tmp_path / "out"), "-j", "1", "--report"]) == 0
        assert "100 %" in Reader((tmp_path / "out" / "report.html").read_text()).text
        assert f"wrote {tmp_path / 'out' / 'report.html'}" in capsys.readouterr().out


class TestAgainst:
    def test_only_common_problems_are_compared(self, tmp_path):
        ours = made(tmp_path, 100)
        with open(tmp_path / "tlc.csv", "w", encoding="utf-8") as file:
            file.write("problem,seconds,mips\n")
            file.writelines(f"{row['problem']},{row['seconds'] * 20},3\n" for row in ours[:60])
            file.write("elsewhere/1,5,1\n")
        text = Reader(written(tmp_path, tmp_path / "t.csv", tmp_path / "tlc.csv")).text
        assert "60 problems in both runs; median 20 times faster" in text
        assert "against 3" in text

    def test_times_of_zero_are_not_compared(self, tmp_path):
        ours = made(tmp_path, 20)
        rows = [f"{row['problem']},{row['seconds'] * 3 if k < 5 else 0}\n" for k, row in enumerate(ours)]
        (tmp_path / "o.csv").write_text("problem,seconds\n" + "".join(rows))
        text = Reader(written(tmp_path, tmp_path / "t.csv", tmp_path / "o.csv")).text
        assert "5 problems in both runs; median 3 times faster" in text

    def test_nothing_in_common(self, tmp_path):
        made(tmp_path, 10)
        (tmp_path / "o.csv").write_text("problem,seconds\nz,1\n")
        assert "No problem of o.csv" in Reader(written(tmp_path, tmp_path / "t.csv", tmp_path / "o.csv")).text


class TestFigures:
    def ticks(self, tree, anchor):
        """Positions (x, y) of the labels of an axis: "middle" for the horizontal one, "end" for the vertical one."""
        labels = [text for text in tree.iter("text") if f"text-anchor: {anchor}" in text.get("style")]
        return {text.text: (float(text.get("x")), float(text.get("y"))) for text in labels}

    def grid(self, tree):
        """The positions of the vertical and of the horizontal lines of the grid."""
        lines = [path.get("d") for path in tree.iter("path") if "var(--line)" in path.get("style")]
        ends = [np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", line), dtype=float) for line in lines]
        return [sorted({a[k] for a, b in ends if a[k] == b[k]}) for k in (0, 1)]

    def bars(self, svg):
        """The left ends and the heights of the bars, heights in units of the grid."""
        tree = ET.fromstring(svg)
        shares = sorted(float(label[:-2]) / 100 for label in self.ticks(tree, "end"))
        rows = self.grid(tree)[1][::-1]
        assert len(rows) == len(shares)
        bars = []
        for path in tree.iter("path"):
            if "fill: var(--ours)" in path.get("style"):
                corners = np.array(re.findall(r"[ML] ([\d.]+) ([\d.]+)", path.get("d")), dtype=float)
                height = shares[-1] * (rows[0] - corners[:, 1].min()) / (rows[0] - rows[-1])
                bars.append((corners[:, 0].min(), height))
        return bars

    def test_histogram_counts(self):
        values = 10 ** np.random.default_rng(1).uniform(-2, 2, 5000)
        bars = self.bars(charts.histogram([("ours", values)], "x"))
        counts = np.histogram(np.log10(values), np.linspace(-2, 2, 25))[0] / 5000
        assert len(bars) == 24
        np.testing.assert_allclose([share for _, share in bars], counts, atol=2e-4)
        assert sum(share for _, share in bars) == pytest.approx(1, abs=2e-3)

    def test_values_without_a_logarithm(self):
        bars = self.bars(charts.histogram([("ours", np.array([0.0, 0.0, 1.0, np.nan, np.inf]))], "x"))
        assert [round(share, 2) for _, share in bars if share > 0] == [0.67, 0.33]
        for nothing in ([], [np.nan], [1.0]):
            ET.fromstring(charts.histogram([("ours", np.array(nothing))], "x"))
            ET.fromstring(charts.scatter([("ours", np.array(nothing), np.array(nothing))], "x", "y", same=True))

    def test_dots_are_at_the_positions_of_the_ticks(self):
        svg = charts.scatter([("ours", np.array([10.0, 1000.0, -1.0]), np.array([1.0, 0.01, 1.0]))], "x", "y")
        tree = ET.fromstring(svg)
        columns, rows = self.grid(tree)
        x = dict(zip(["10", "100", "1000"], columns, strict=True))
        y = dict(zip(["1", "0.1", "0.01"], rows, strict=True))
        for word, place in x.items():
            assert self.ticks(tree, "middle")[word][0] == pytest.approx(place)
        for word, place in y.items():
            assert self.ticks(tree, "end")[word][1] == pytest.approx(place, abs=6)
        path = next(p.get("d") for p in tree.iter("path") if "stroke: var(--ours)" in p.get("style"))
        dots = sorted((float(a), float(b)) for a, b in re.findall(r"M ([\d.]+) ([\d.]+)", path))
        np.testing.assert_allclose(dots, [(x["10"], y["1"]), (x["1000"], y["0.01"])], atol=0.6)

    def test_figures_use_the_colours_of_the_page(self):
        values = np.array([1.0, 10.0])
        series = [("ours", values), ("theirs", values)]
        for svg in (charts.histogram(series, "x"), charts.scatter([("failed", values, values)], "x", "y", same=True)):
            assert not re.search(r"#[0-9a-f]{6}", svg)
            assert not re.search(r" id=|url|href|xmlns", svg)
            assert {f"--{name}" for name in re.findall(r"var\(--(\w+)\)", svg)} <= set(re.findall(r"--\w+", STYLE))

    @pytest.mark.parametrize(
        ("value", "text"),
        [(0, "0"), (0.0123, "0.0123"), (1234.5, "1,234"), (3.07e6, "3.07·10⁶"), (1e-7, "1·10⁻⁷"), (np.nan, "–")],
    )
    def test_numbers_are_formatted_for_reading(self, value, text):
        assert page.number(value) == text

    def test_percentages_below_all_are_not_rounded_to_100(self):
        assert page.percent(99_999, 100_000) == "99.99 %"
        assert page.percent(100, 100) == "100 %"

    def test_quantiles_ignore_missing_values(self):
        assert statistics.quantile(np.array([1.0, np.nan, 3.0, np.inf]), 0.5) == 2.0
        assert np.isnan(statistics.quantile(np.array([np.nan]), 0.5))


BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.mark.skipif(BROWSER is None, reason="no Chromium here")
def test_in_a_browser_in_light_and_dark_mode(tmp_path):
    from matplotlib.image import imread

    made(tmp_path, 60)
    written(tmp_path, tmp_path / "t.csv")
    pictures = []
    for scheme in (1, 0):
        command = [
            BROWSER,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--window-size=1000,900",
        ]
        command += [f"--blink-settings=preferredColorScheme={scheme}", f"--screenshot={tmp_path / 's.png'}"]
        command += [f"--user-data-dir={tmp_path / 'profile'}", (tmp_path / "report.html").as_uri()]
        subprocess.run(command, check=True, capture_output=True, timeout=60)
        pictures.append(imread(tmp_path / "s.png")[..., :3])
    for picture, brightness in zip(pictures, (0.96, 0.08), strict=True):
        assert np.median(picture) == pytest.approx(brightness, abs=0.06)
        # There is ink throughout the upper part, and a figure's bars are in the middle.
        assert (np.abs(picture[:300] - picture[0, 0]).max(axis=2) > 0.3).any(axis=1).mean() > 0.3
