"""Write the HTML page of a report, without external resources.

Its style sheet has light and dark colours, and rules for print and small screens.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from html import escape
from importlib.resources import files
from math import isfinite, isnan
from string import Template
from typing import NamedTuple, TypeAlias

import numpy as np

from quasiharmonic.io.atomic import check_writable, write_whole
from quasiharmonic.io.untrusted import parse_json
from quasiharmonic.ui.batch.records import OUTCOMES, SOLVED, Record
from quasiharmonic.ui.batch.settings import Settings
from quasiharmonic.ui.report import charts, statistics
from quasiharmonic.ui.report.charts import thumbnail
from quasiharmonic.ui.report.statistics import PHASES, BatchRun, find_worst, quantile

STYLE = files(__package__).joinpath("style.css").read_text(encoding="utf-8")
_PAGE = Template(files(__package__).joinpath("page.html").read_text(encoding="utf-8"))


class ListLimits(NamedTuple):
    """Maximum lengths of the lists of a report."""

    # Problems per list of certified maps.
    pictures: int = 12
    # Failures with a picture.
    failures: int = 24
    # Failures that are listed.
    listed: int = 500


_LIMITS = ListLimits()

# A function from a record to the ``data:`` address of its picture, or an empty string.
Draw: TypeAlias = Callable[[Record], str]


def write_report(
    path: str | os.PathLike[str], source: str | os.PathLike[str], against: str | os.PathLike[str] | None = None
) -> None:
    """Write an HTML page about a run: success, distortion, times, and notable problems.

    ``source`` is the folder of a run or a table of records. ``against`` is another run, or a table about another
    program with the columns ``problem``, ``seconds`` and optionally ``mips`` and ``certified``. ValueError if there are
    no records, or they cannot be read; OutputError if the page cannot be written.
    """
    check_writable(path)
    run = statistics.load(source)
    other = None if against is None else statistics.load(against)
    write_whole(path, _page(run, other).encode())


def _page(run: BatchRun, other: BatchRun | None) -> str:
    title = f"Report: {escape_text(run.name)}"
    drawn: dict[str, str] = {}

    def draw(row: Record) -> str:
        name = row["problem"]
        if name not in drawn:
            drawn[name] = thumbnail(row, run.results)
        return drawn[name]

    sections = [
        f"<h1>{title}</h1>",
        _origin(run),
        _tiles(run),
        _outcomes(run),
        _groups(run),
        _describe_unwraps(run),
        '<div class="pair">',
        _distortion(run, other),
        _times(run) if other is None else _comparison(run, other),
        *([] if other is None else [_times(run)]),
        _phases(run),
        "</div>",
        _gallery(
            "Highest stretch, max(σ₁, 1/σ₂), of certified maps", draw, _order_by(run, "isometric")[: _LIMITS.pictures]
        ),
        _gallery("Highest MIPS distortion of certified maps", draw, _order_by(run, "mips")[: _LIMITS.pictures]),
        _gallery("Slowest certified maps", draw, _order_by(run, "seconds")[: _LIMITS.pictures]),
        _failures(run, draw),
    ]
    return _PAGE.substitute(title=title, style=STYLE, sections="\n".join(filter(None, sections)))


def escape_text(text: object) -> str:
    """Return untrusted text as HTML; characters that do not print or change the reading direction are escaped."""
    plain = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))
    return escape(plain)


def number(value: float, unit: str = "") -> str:
    """Format a number with three digits; a dash for NaN."""
    if isnan(value):
        return "–"
    text = f"{value:,.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}" if isfinite(value) else "∞"
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa}·{charts.power(int(exponent))}"
    return text + (f" {unit}" if unit else "")


def percent(part: int, total: int) -> str:
    """Format a share; "100 %" only if it is exact."""
    share = 100 * part / total
    return "100 %" if part == total else f"{min(share, 99.99):.2f} %" if share >= 99 else f"{share:.1f} %"


def _origin(run: BatchRun) -> str:
    words = []
    if run.about.get("source"):
        words.append(f"Problems of <code>{escape_text(run.about['source'])}</code>.")
    usual = Settings().to_dict()
    settings = {k: v for k, v in run.about.get("settings", {}).items() if v and v != usual.get(k)}
    if settings:
        words.append("Settings: " + ", ".join(f"{escape_text(k)} {escape_text(v)}" for k, v in settings.items()) + ".")
    for versions in sorted({str(row["versions"]) for row in run.rows if row.get("versions")}):
        try:
            words.append(", ".join(f"{escape_text(k)} {escape_text(v)}" for k, v in parse_json(versions).items()) + ".")
        except (ValueError, AttributeError):
            continue
    return f'<p class="quiet">{" ".join(words)}</p>' if words else ""


def _tiles(run: BatchRun) -> str:
    certified, problems = int(run.certified.sum()), len(run.rows)
    stretch, mips, seconds = (run.certified_column(name) for name in ("isometric", "mips", "seconds"))
    usual_stretch, usual_mips = (number(quantile(values, 0.5)) for values in (stretch, mips))
    usual_time, late = (number(quantile(seconds, share), "s") for share in (0.5, 0.95))
    tiles = [
        (percent(certified, problems), f"{certified:,} of {problems:,} certified {run.wanted}"),
        (number(find_worst(stretch)), f"worst stretch, max(σ₁, 1/σ₂), of a triangle; median {usual_stretch}"),
        (number(find_worst(mips)), f"worst MIPS distortion of a map; median {usual_mips}"),
        (usual_time, f"median time of the certified; 95 % within {late}"),
        (number(float(np.nansum(run.column("triangles")))), "triangles in total"),
        (number(quantile(run.column("peak_memory"), 1.0) / 2**20, "MiB"), "maximum memory of a problem"),
    ]
    cells = "".join(f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in tiles)
    return f'<div class="tiles">{cells}</div>'


def _outcomes(run: BatchRun) -> str:
    counted = statistics.outcomes(run)
    css = {**dict.fromkeys(SOLVED, "good"), "not injective": "bad", "not bijective": "bad"}
    bar = "".join(f'<i class="{css.get(name, "broken")}" style="flex:{count}"></i>' for name, count in counted)
    words = ", ".join(f"{count:,} {escape_text(OUTCOMES.get(name, name))}" for name, count in counted)
    impossible = sum(row.get("status") == "impossible" for row in run.rows)
    words += f"; {impossible:,} proven to have no such map" if impossible else ""
    return f'<div class="bar">{bar}</div><p class="quiet">{words}</p>'


def _groups(run: BatchRun) -> str:
    groups = statistics.groups(run)
    if len(groups) == 1:
        return ""
    head = "problems", "certified", "success", "worst stretch", "worst MIPS", "median MIPS", "median", "95 %", "longest"
    rows = []
    for group in groups:
        certified, problems = int(group.certified.sum()), len(group.rows)
        stretch, mips, seconds = (group.certified_column(name) for name in ("isometric", "mips", "seconds"))
        success = f"{problems:,}", f"{certified:,}", percent(certified, problems)
        distortion = (number(value) for value in (find_worst(stretch), find_worst(mips), quantile(mips, 0.5)))
        times = (number(quantile(seconds, share), "s") for share in (0.5, 0.95, 1.0))
        rows.append((escape_text(group.name or "(top)"), *success, *distortion, *times))
    return _table(("folder", *head), rows, last_is_sum=True)


def _describe_unwraps(run: BatchRun) -> str:
    """Return a table of the charts of unwrapped models, those with most charts first; empty for maps."""
    certified = _order_by(run, "charts")
    rows = certified[: _LIMITS.listed]
    if not rows:
        return ""
    lines = [
        (
            escape_text(row["problem"]),
            *(_value(row, name) for name in ("charts", "seam_length", "stretch", "utilisation")),
            escape_text(row.get("cleaned") or "–"),
        )
        for row in rows
    ]
    count, stretch, use = (
        number(quantile(run.certified_column(name), 0.5)) for name in ("charts", "stretch", "utilisation")
    )
    cleaned = sum(bool(row.get("cleaned")) for row in run.rows)
    words = (
        f"Medians: {count} charts, stretch {stretch}, {use} of the texture used. "
        f"{cleaned:,} of {len(run.rows):,} models were cleaned."
    )
    if len(certified) > len(rows):
        words += f" The table of records lists more than these {len(rows)}."
    head = "model", "charts", "seam length", "stretch of 99 %", "used texture", "cleaned"
    return f"<h2>Charts</h2><p>{words}</p>{_table(head, lines)}"


def _distortion(run: BatchRun, other: BatchRun | None) -> str:
    if not np.isfinite(run.certified_column("mips")).any() and np.isfinite(run.column("charts")).any():
        return ""
    series = [("ours", run.certified_column("mips"))]
    legend = [("ours", run.name)]
    if other is not None:
        mips = other.column("mips")
        known = np.array(["certified" in row for row in other.rows], dtype=np.bool_)
        mips = mips[other.certified | ~known]
        if np.isfinite(mips).any():
            series.append(("theirs", mips))
            legend.append(("theirs", other.name))
    medians = [number(quantile(values, 0.5)) for _, values in series]
    caption = f"Over the certified maps. Median {' against '.join(medians)}."
    return _figure(
        "Distribution of distortion",
        charts.histogram(series, "MIPS: mean of σ₁/σ₂ + σ₂/σ₁ − 2 over the surface"),
        legend if len(legend) > 1 else [],
        caption,
    )


def _times(run: BatchRun) -> str:
    good = run.certified
    size, seconds = run.column("triangles"), run.column("seconds")
    series = [("ours", size[good], seconds[good]), ("failed", size[~good], seconds[~good])]
    legend = [("ours", f"certified {run.wanted}"), ("failed", "failed")] if not good.all() else []
    caption = "Each dot is a problem; wall time from the file to the record."
    return _figure("Time and size", charts.scatter(series, "triangles", "seconds"), legend, caption)


def _comparison(run: BatchRun, other: BatchRun) -> str:
    ours, theirs = statistics.match_column(run, other, "seconds")
    timed = (ours > 0) & (theirs > 0)
    ours, theirs = ours[timed], theirs[timed]
    name = escape_text(other.name)
    if not ours.size:
        words = f"No problem of {name} has a time and the name of a problem of this run."
        return f'<section class="card"><h2>Time against {name}</h2><p>{words}</p></section>'
    ratio = quantile(theirs / ours, 0.5)
    sentence = f"median {number(ratio)} times faster" if ratio >= 1 else f"median {number(1 / ratio)} times slower"
    return _figure(
        f"Time against {name}",
        charts.scatter([("ours", theirs, ours)], "seconds of the other run", "seconds of this run", same=True),
        [],
        f"Each dot is one of the {ours.size:,} problems in both runs; {sentence}.",
    )


def _phases(run: BatchRun) -> str:
    totals = [(phase, float(np.nansum(run.column(f"seconds_{phase}")))) for phase in PHASES]
    whole = sum(total for _, total in totals)
    if not whole:
        return ""
    rows = [(phase, number(total, "s"), f"{100 * total / whole:.1f} %") for phase, total in totals if total]
    rows.append(("all", number(whole, "s"), "100 %"))
    table = _table(("phase", "time", "share"), rows, last_is_sum=True)
    return f'<section class="card"><h2>Time by phase</h2>{table}</section>'


def _order_by(run: BatchRun, column: str) -> list[Record]:
    """Return the certified records with a value in a column, the highest first."""
    values = np.where(run.certified, run.column(column), np.nan)
    order = np.argsort(-values, kind="stable")
    return [run.rows[k] for k in order if not np.isnan(values[k])]


def _gallery(title: str, draw: Draw, rows: Sequence[Record]) -> str:
    if not rows:
        return ""
    return f'<h2>{title}</h2><div class="gallery">{"".join(_card(row, draw(row)) for row in rows)}</div>'


def _card(row: Record, address: str) -> str:
    picture = f'<img src="{address}" alt="">' if address else '<div class="nothing">no picture</div>'
    facts = []
    for column, form in (
        ("triangles", "{} triangles"),
        ("seconds", "{} s"),
        ("mips", "MIPS {}"),
        ("isometric", "max(σ₁, 1/σ₂) {}"),
    ):
        value = row.get(column)
        if isinstance(value, int | float):
            facts.append(form.format(number(value)))
    if row.get("flips_after"):
        facts.append(f"{row['flips_after']} inverted, {row.get('flips_before')} initially")
    words = f'<p class="why">{escape_text(_reason(row))}</p>' if row.get("certified") is not True else ""
    title, line = escape_text(row["problem"]), escape_text(" · ".join(facts))
    return f'<div class="card item">{picture}<h3>{title}</h3><p>{line}</p>{words}</div>'


def _reason(row: Record) -> str:
    outcome = str(row.get("outcome") or "")
    error = " ".join(str(row.get("error") or "").split())
    words = OUTCOMES.get(outcome, outcome)
    text = f"{words}: {error}" if words and error else words or error
    return text if len(text) <= 400 else text[:399] + "…"


def _failures(run: BatchRun, draw: Draw) -> str:
    rows = [row for row in run.rows if row.get("certified") is not True]
    if not rows:
        return "<h2>Failed</h2><p>None.</p>"
    parts = [_gallery(f"Failed ({len(rows):,})", draw, rows[: _LIMITS.failures])]
    rest = rows[_LIMITS.failures : _LIMITS.listed]
    if rest:
        parts.append(_table(("problem", "triangles", "time", "reason"), [_line(row) for row in rest]))
    if len(rows) > _LIMITS.listed:
        parts.append(f"<p>And {len(rows) - _LIMITS.listed:,} more; the table of records lists them.</p>")
    return "".join(parts)


def _line(row: Record) -> tuple[str, ...]:
    sizes = _value(row, "triangles"), _value(row, "seconds", "s")
    return escape_text(row["problem"]), *sizes, escape_text(_reason(row))


def _value(row: Record, column: str, unit: str = "") -> str:
    """Format a number of a record; a dash if there is none."""
    value = row.get(column)
    return number(float("nan") if value is None else float(value), unit)


def _figure(title: str, drawing: str, legend: Iterable[tuple[str, str]], caption: str) -> str:
    """Return a card with a figure; title and caption are HTML."""
    keys = "".join(f'<span><i class="{css}"></i>{escape_text(name)}</span>' for css, name in legend)
    keys = f'<div class="legend">{keys}</div>' if keys else ""
    return f'<section class="card"><h2>{title}</h2>{keys}{drawing}<p class="quiet">{caption}</p></section>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], *, last_is_sum: bool = False) -> str:
    """Return a table; all cells are HTML."""
    top = "".join(f"<th>{cell}</th>" for cell in head)
    lines = ["".join(f"<td>{cell}</td>" for cell in row) for row in rows]
    body = "".join(
        f'<tr class="sum">{line}</tr>' if last_is_sum and k == len(lines) - 1 else f"<tr>{line}</tr>"
        for k, line in enumerate(lines)
    )
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
