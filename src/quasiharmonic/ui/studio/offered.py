"""The options of `unwrap` that the page offers, with defaults, choices and explanations from `UnwrapOptions`."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from quasiharmonic.util.options import UnwrapOptions

# Explanations of the options that the command line explains itself, because files have a part in them.
_TEXTS = {
    "hard_edges": "seams at all edges with a larger angle between the normals, in degrees, as normal maps need them",
    "labels": "parts of the file, between which seams cost almost nothing",
}
_CHOICES = {"labels": ("groups", "materials")}
#: Names of the options, in the order of the page.
NAMES = (
    *("max_stretch", "max_charts", "symmetry", "hard_edges", "labels", "straighten", "up"),
    *("divide_for_packing", "texels_per_unit"),
)


def offered_options() -> list[dict[str, Any]]:
    """Return name, explanation, default and choices of each option; a switch has the default False."""
    known = {one.name: one for one in fields(UnwrapOptions)}
    return [
        {
            "name": name,
            "help": (known[name].metadata["help"] or _TEXTS[name]).replace("%%", "%"),
            "default": known[name].default,
            "choices": known[name].metadata["choices"] or _CHOICES.get(name, ()),
        }
        for name in NAMES
    ]
