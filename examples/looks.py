"""Ways to draw a map
=====================

Distortion, a checkerboard, and an animation of the search in which inverted triangles are red.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

from PIL import Image

from common import run
from quasiharmonic import distortion, injective_map, surfaces, targets
from quasiharmonic.plot import save_animation, save_distortion_figure, save_texture_figure
from quasiharmonic.ui.plot.interactive import show


def main(output: Path, size: int = 24, window: bool = False) -> dict[str, Any]:
    output.mkdir(parents=True, exist_ok=True)
    V, F = surfaces.cat(size)
    fixed, target = targets.boundary_to(V, F, targets.filled(targets.letter("R")))
    result = injective_map(V, F, fixed, target, record_every=1, polish="symmetric-dirichlet")
    frames = [(f"iteration {step.iteration}", step.uv) for step in result.path]
    save_animation(output / "looks.gif", V, F, frames, fixed=fixed)
    save_texture_figure(output / "looks.png", V, F, result.uv)
    save_distortion_figure(output / "looks_distortion.png", V, F, result.uv)
    numbers = {
        "frames": len(frames),
        "inverted at first": int(result.history[0].inverted),
        "inverted": int(result.history[-1].inverted),
        "median stretch": float(distortion(V, F, result.uv).statistics("isometric").median),
    }
    if window and find_spec("polyscope") is not None:
        show(V, F, result.uv, screenshot=output / "looks_window.png")
        with Image.open(output / "looks_window.png") as picture:
            numbers["window"] = list(picture.size)
    return numbers


if __name__ == "__main__":
    run(main)
