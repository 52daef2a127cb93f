"""Ways to look at a map: distortion, a checkerboard, the way there, a window
==========================================================================

The map of a cat's head onto the letter R, drawn as by ``qhm plot`` and ``qhm view``. ``--kind distortion`` colours the
triangles by their stretch and adds a histogram. ``--kind texture`` draws a checkerboard on the surface, which shows
where the map changes angles or sizes. The window shows both in 3D (polyscope, the extra ``view``). The animation shows
the search: ``record_every=1`` records every iteration's map, and inverted triangles are red.
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
        "median stretch": float(distortion(V, F, result.uv).summary("isometric").median),
    }
    if window and find_spec("polyscope") is not None:
        show(V, F, result.uv, screenshot=output / "looks_window.png")
        with Image.open(output / "looks_window.png") as picture:
            numbers["window"] = list(picture.size)
    return numbers


if __name__ == "__main__":
    run(main)
