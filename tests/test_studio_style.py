"""The page's colours: contrast by WCAG 2.2, 4.5 : 1 for text (AA), 3 : 1 for controls and handles."""

from __future__ import annotations

import re

import pytest

from quasiharmonic.ui.studio.page import assets

TEXT, SHAPE = 4.5, 3.0


def declarations(*names):
    """Return (selector, property) -> value of every rule of some style sheets; later ones precede."""
    css = "".join(assets()[name].content.decode() for name in names)
    css = re.sub(r"/\*.*?\*/", "", css, flags=re.DOTALL)
    return {
        (" ".join(selectors.split()), name.strip()): value.strip()
        for selectors, body in re.findall(r"([^{}]+)\{([^{}]*)\}", css)
        for name, _, value in (line.partition(":") for line in body.split(";") if ":" in line)
    }


SHEETS = {
    "light": declarations("style.css", "controls.css"),
    "dark": declarations("style.css", "controls.css", "dark.css"),
}


def colour(sheet, value):
    """Return the only colour in a value, as six hexadecimal digits; None if there is none, or several."""
    value = re.sub(r"var\((--\w+(?:-\w+)*)\)", lambda found: sheet[":root", found[1]], value)
    found = re.findall(r"#([0-9a-f]{6})\b", value)
    return found[0] if len(found) == 1 else None


def luminance(digits):
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def root(sheet, name):
    return colour(sheet, sheet[":root", f"--{name}"])


def grounds(sheet):
    """Return the colours on which text without a background of its own stands."""
    return [root(sheet, name) for name in ("paper", "ground", "raised")]


def texts():
    """Return every pair of text and background colours."""
    for scheme, sheet in SHEETS.items():
        for selector in dict.fromkeys(selector for selector, _ in sheet):
            own = colour(sheet, sheet.get((selector, "color"), ""))
            ground = colour(sheet, sheet.get((selector, "background"), ""))
            for behind in [ground] if ground else grounds(sheet) if own else []:
                yield pytest.param(own or root(sheet, "ink"), behind, id=f"{scheme} {selector}")


@pytest.mark.parametrize(("text", "ground"), list(texts()))
def test_text_has_enough_contrast(text, ground):
    assert contrast(text, ground) >= TEXT


@pytest.mark.parametrize("scheme", SHEETS)
def test_edges_of_controls_and_the_focus_have_enough_contrast(scheme):
    sheet = SHEETS[scheme]
    assert min(contrast(root(sheet, name), ground) for name in ("edge", "accent") for ground in grounds(sheet)) >= SHAPE


def test_both_themes_have_the_same_colours():
    names = [{name for selector, name in declarations(file) if selector == ":root" and name.startswith("--")}
             for file in ("style.css", "dark.css")]  # fmt: skip
    assert names[0] == names[1]


def test_drawings_on_the_map_have_enough_contrast():
    drawn = dict(re.findall(r'const (\w+) = "#([0-9a-f]{6})"', assets()["overlay.js"].content.decode()))
    assert set(drawn) == {"INK", "RED", "HANDLE", "PIN", "PAPER"}
    assert all(contrast(drawn[name], drawn["PAPER"]) >= SHAPE for name in set(drawn) - {"PAPER"})


def test_contrast_agrees_with_published_values():
    assert contrast("ffffff", "000000") == pytest.approx(21)
    assert contrast("767676", "ffffff") == pytest.approx(4.54, abs=0.005)
    assert contrast("777777", "ffffff") == pytest.approx(4.48, abs=0.005)
