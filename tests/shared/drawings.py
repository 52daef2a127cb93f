"""SVG drawings from strings."""

from __future__ import annotations


def drawing(body, attributes=""):
    return f'<svg xmlns="http://www.w3.org/2000/svg" {attributes}>{body}</svg>'
