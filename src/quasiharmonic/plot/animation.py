"""Moving pictures of maps: how a search comes by one, or how a map follows its boundary."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from io import BytesIO
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.arrays import map_array
from quasiharmonic.given.taking import writes_mesh
from quasiharmonic.plot.canvas import as_mesh, new_figure, not_positive, paint_map, verdict
from quasiharmonic.plot.shading import view

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@writes_mesh
def save_animation(
    path: str | PathLike[str],
    V: ArrayLike,
    F: ArrayLike,
    frames: Iterable[tuple[str, ArrayLike]],
    *,
    fixed: ArrayLike | None = None,
    frames_per_second: int = 12,
) -> None:
    """Write an animation of maps of one surface, inverted triangles in red; 600 × 600 pixels.

    Parameters
    ----------
    path, frames_per_second
        As for `save_figures`.
    V : (n, 2) or (n, 3) float, or a mesh in place of ``V`` and ``F``
        The rest surface, whose look colours the triangles.
    F : (f, 3) int
    frames : iterable of (str, (n, 2) float)
        What each frame is called, and its map. All are shown in the window of the first.
    fixed : (k,) int, optional
        Vertices held in place; those not on the boundary are marked.

    Raises
    ------
    ValueError
        When a vertex is not finite, and what `save_figures` raises.
    ImportError, quasiharmonic.io.errors.OutputError
        As for `save_figures`.
    """
    save_figures(path, _figures(V, F, frames, fixed), frames_per_second=frames_per_second)


def save_figures(path: str | PathLike[str], figures: Iterable[Figure], *, frames_per_second: int = 12) -> None:
    """Write figures as an animation.

    Parameters
    ----------
    path : path
        Ends in ``.gif``, or in ``.mp4`` where the program ffmpeg or the extra ``video`` is installed. Replaced as a
        whole once the animation is complete.
    figures : iterable of matplotlib Figure
        Of one size. They are drawn one after another, so a generator will do.
    frames_per_second : int
        The last frame of a GIF stays for a second more.

    Raises
    ------
    ValueError
        When there are no figures, the suffix is another, or the rate is less than 1.
    ImportError
        When the suffix is ``.mp4`` and neither is there.
    quasiharmonic.io.errors.OutputError
        When the file cannot be written.
    """
    from quasiharmonic.io.atomic import check_writable, write_whole

    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: animations are written as .gif or .mp4")
    if frames_per_second < 1:
        raise ValueError(f"frames_per_second must be at least 1, not {frames_per_second}")
    if suffix == ".mp4":
        _ffmpeg()
    check_writable(path)
    pictures = [_picture(figure) for figure in figures]
    if not pictures:
        raise ValueError("there are no frames")
    encode = _gif if suffix == ".gif" else _mp4
    write_whole(path, encode(pictures, frames_per_second))


def _figures(
    V: ArrayLike, F: ArrayLike, frames: Iterable[tuple[str, ArrayLike]], fixed: ArrayLike | None
) -> Iterable[Figure]:
    """Yield a figure of every frame."""
    rest, F = as_mesh(V, F)
    color = view(rest, F).color
    window: tuple[tuple[float, float], tuple[float, float]] | None = None
    for name, uv in frames:
        place = map_array(name, uv, len(rest))
        figure = new_figure((6, 6))
        ax = figure.add_axes((0.02, 0.02, 0.96, 0.88))
        inverted = not_positive(F, place)
        paint_map(ax, F, place, color, inverted, fixed)
        window = window or (ax.get_xlim(), ax.get_ylim())
        ax.set(xlim=window[0], ylim=window[1])
        verdict(ax, name, len(inverted))
        yield figure


def _picture(figure: Figure) -> NDArray[np.uint8]:
    """A figure's pixels, (height, width, 3)."""
    file = BytesIO()
    figure.savefig(file, format="rgba")
    width, height = (int(side) for side in figure.bbox.size)
    return np.frombuffer(file.getvalue(), dtype=np.uint8).reshape(height, width, 4)[..., :3]


def _gif(pictures: list[NDArray[np.uint8]], rate: int) -> bytes:
    from PIL import Image

    # One palette for all frames, made from the first and the last, so that colours do not flicker.
    both = Image.fromarray(np.concatenate([pictures[0], pictures[-1]]))
    palette = both.quantize(255, dither=Image.Dither.NONE)
    images = [Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    times = [round(1000 / rate)] * len(images)
    times[-1] += 1000
    file = BytesIO()
    images[0].save(file, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0, optimize=False)
    return file.getvalue()


def _ffmpeg() -> str:
    """Where the program ffmpeg is, on the path or in the extra ``video``."""
    if (found := shutil.which("ffmpeg")) is not None:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError:
        raise ImportError(
            "an .mp4 needs the program ffmpeg: pip install 'quasiharmonic[video]' brings it, or write a .gif"
        ) from None
    return str(get_ffmpeg_exe())


def _mp4(pictures: list[NDArray[np.uint8]], rate: int) -> bytes:
    from matplotlib import rc_context
    from matplotlib.animation import FFMpegWriter

    height, width = (side - side % 2 for side in pictures[0].shape[:2])  # of which the codec wants even ones
    figure = new_figure((width / 100, height / 100))
    image = figure.add_axes((0, 0, 1, 1))
    image.set_axis_off()
    shown = image.imshow(pictures[0], interpolation="none")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "animation.mp4"
        # yuv420p is what browsers and phones play.
        writer = FFMpegWriter(fps=rate, codec="h264", extra_args=["-pix_fmt", "yuv420p"])
        with rc_context({"animation.ffmpeg_path": _ffmpeg()}), writer.saving(figure, str(target), dpi=100):
            for picture in pictures:
                shown.set_data(picture)
                writer.grab_frame()
        return target.read_bytes()
