"""Figures over time: animations of maps, for example of a moving boundary, and the convergence of a search."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from itertools import chain, pairwise
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quasiharmonic.io.accepts_mesh import writer_accepts_mesh
from quasiharmonic.io.errors import check_path
from quasiharmonic.problem.result import MapResult, Step
from quasiharmonic.ui.plot.canvas import (
    AS_DRAWN,
    RED,
    as_mesh,
    find_not_positive,
    name_axes,
    new_figure,
    paint_map,
    verdict,
    view,
)
from quasiharmonic.util.arrays import FloatArray, check_instance, check_integer, check_sequence, map_array
from quasiharmonic.util.hints import explain_missing

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL import Image

# A GIF stores frame durations in hundredths of a second.
_HUNDREDTHS = 100
# Shortest duration in hundredths; viewers do not respect 1/100 s.
_SHORTEST = 2
# Number of colours of a GIF's palette.
_COLOURS = 255
_NONE = "there are no frames"
_COLORS = ((0.16, 0.38, 0.75), (0.06, 0.55, 0.50), (0.80, 0.50, 0.05), (0.45, 0.35, 0.75))


@writer_accepts_mesh
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
        The rest surface, whose shading colours the triangles.
    F : (f, 3) int
    frames : iterable of (str, (n, 2) float)
        Name and map of each frame. All frames share one window that contains all maps.
    fixed : (k,) int, optional
        Fixed vertices; those in the interior are marked.

    Raises
    ------
    ValueError
        If a vertex is not finite, or as for `save_figures`.
    ImportError, quasiharmonic.io.errors.OutputError
        As for `save_figures`.
    """
    check_sequence("frames", frames, "pairs of a name and a map")
    save_figures(path, _figures(V, F, list(frames), fixed), frames_per_second=frames_per_second)


def save_figures(path: str | PathLike[str], figures: Iterable[Figure], *, frames_per_second: int = 12) -> None:
    """Write figures as an animation.

    Parameters
    ----------
    path : path
        Ends in ``.gif`` or ``.mp4``. An ``.mp4`` needs the program ffmpeg or the extra ``video``. The file is replaced
        only when the animation is complete.
    figures : iterable of matplotlib Figure
        All of one size. They are drawn one after another, so a generator is accepted.
    frames_per_second : int
        At most 50 for a GIF. The last frame of a GIF lasts one second longer.

    Raises
    ------
    ValueError
        If there are no figures, the suffix is not supported, or the frame rate is out of range.
    ImportError
        If the suffix is ``.mp4`` and neither ffmpeg nor the extra ``video`` is installed.
    quasiharmonic.io.errors.OutputError
        If the file cannot be written.
    """
    from quasiharmonic.io.atomic import write_whole

    suffix = check_animation(path, frames_per_second)
    encode = _gif if suffix == ".gif" else _mp4
    write_whole(path, encode(map(_picture, figures), frames_per_second))


def check_animation(path: str | PathLike[str], frames_per_second: int) -> str:
    """Check path and frame rate before `save_figures`, with its errors; return the suffix in lower case."""
    from quasiharmonic.io.atomic import check_writable

    check_path("path", path)
    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: an animation must be .gif or .mp4")
    check_integer("frames_per_second", frames_per_second, minimum=1)
    max_rate = _HUNDREDTHS // _SHORTEST
    if suffix == ".gif" and frames_per_second > max_rate:
        raise ValueError(
            f"frames_per_second of a GIF must be at most {max_rate}, not {frames_per_second}: write an .mp4"
        )
    if suffix == ".mp4":
        _ffmpeg()
    check_writable(path)
    return suffix


def _figures(
    V: ArrayLike, F: ArrayLike, frames: list[tuple[str, ArrayLike]], fixed: ArrayLike | None
) -> Iterable[Figure]:
    """Yield one figure per frame."""
    rest, F = as_mesh(V, F)
    color = view(rest, F).color
    maps = [(name, map_array(name, uv, len(rest))) for name, uv in frames]
    window = _extent(np.concatenate([_extent(place) for _, place in maps])) if maps else None
    for name, place in maps:
        figure = new_figure((6, 6))
        ax = figure.add_axes((0.02, 0.02, 0.96, 0.88))
        inverted = find_not_positive(F, place)
        paint_map(ax, F, place, color, inverted, fixed, window)
        verdict(ax, name, len(inverted))
        yield figure


def _extent(points: FloatArray) -> FloatArray:
    """Return the lower left and the upper right corner of the bounding box of points; (2, 2)."""
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _picture(figure: Figure) -> NDArray[np.uint8]:
    """Return the pixels of a figure, (height, width, 3) uint8."""
    from matplotlib import rc_context

    file = BytesIO()
    with rc_context(AS_DRAWN):
        figure.savefig(file, format="rgba")
    width, height = (int(side) for side in figure.bbox.size)
    return np.frombuffer(file.getvalue(), dtype=np.uint8).reshape(height, width, 4)[..., :3]


def _gif(pictures: Iterable[NDArray[np.uint8]], rate: int) -> bytes:
    from PIL import Image

    # All frames share one palette, so that colours do not flicker. It is made of the palettes of the frames, which keep
    # colours that only few frames use. The frames are stored compressed until it is known.
    palettes, packed = bytearray(), []
    shape: tuple[int, ...] = ()
    for picture in pictures:
        half = np.ascontiguousarray(picture[::2, ::2])
        palettes += bytes(Image.fromarray(half).quantize(_COLOURS).getpalette() or ())
        packed.append(zlib.compress(picture.tobytes(), 1))
        shape = picture.shape
    if not packed:
        raise ValueError(_NONE)
    every = Image.frombytes("RGB", (len(palettes) // 3, 1), bytes(palettes))
    palette = every.quantize(_COLOURS, method=Image.Quantize.MAXCOVERAGE)

    def quantize(data: bytes) -> Image.Image:
        picture = np.frombuffer(zlib.decompress(data), dtype=np.uint8).reshape(shape)
        return Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE)

    # Round the end times, not the durations, so that rounding errors do not add up.
    ends = [round(_HUNDREDTHS * (k + 1) / rate) for k in range(len(packed))]
    times = [1000 // _HUNDREDTHS * (end - begin) for begin, end in zip([0, *ends], ends, strict=False)]
    times[-1] += 1000
    file = BytesIO()
    others = map(quantize, packed[1:])
    quantize(packed[0]).save(file, "GIF", save_all=True, append_images=others, duration=times, loop=0, optimize=False)
    return file.getvalue()


def _ffmpeg() -> str:
    """Return the path of the program ffmpeg, from PATH or from the extra ``video``."""
    if (found := shutil.which("ffmpeg")) is not None:
        return found
    with explain_missing("an .mp4 needs the program ffmpeg", extra="video", hint=" brings it, or write a .gif"):
        from imageio_ffmpeg import get_ffmpeg_exe
    return str(get_ffmpeg_exe())


def _mp4(pictures: Iterable[NDArray[np.uint8]], rate: int) -> bytes:
    from matplotlib import rc_context
    from matplotlib.animation import FFMpegWriter

    from quasiharmonic.io.atomic import encode_by

    pictures = iter(pictures)
    first = next(pictures, None)
    if first is None:
        raise ValueError(_NONE)
    height, width = (side - side % 2 for side in first.shape[:2])  # the codec needs even sizes
    figure = new_figure((width / 100, height / 100))
    image = figure.add_axes((0, 0, 1, 1))
    image.set_axis_off()
    shown = image.imshow(first, interpolation="none")

    def write(target: str) -> None:
        # Browsers and phones play yuv420p.
        writer = FFMpegWriter(fps=rate, codec="h264", extra_args=["-pix_fmt", "yuv420p"])
        with rc_context({"animation.ffmpeg_path": _ffmpeg()}), writer.saving(figure, target, dpi=100):
            for picture in chain([first], pictures):
                shown.set_data(picture)
                writer.grab_frame()

    return encode_by("animation.mp4", write)


def plot_convergence(result: MapResult | Sequence[MapResult] | Mapping[str, MapResult]) -> Figure:
    """Draw the energy of a result's history above its number of inverted triangles, over iterations.

    Each run has its own line because runs lower different objectives. A search lowers an energy in excess of the
    target's area; a polish lowers the mean distortion. Values that are not finite or not positive are omitted.

    Parameters
    ----------
    result : MapResult, sequence of MapResult, or mapping from str to MapResult
        Several results have one colour each, and their names or numbers are in the legend.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        If a result has no history, or there are no results.
    """
    from matplotlib.ticker import MaxNLocator

    several = not isinstance(result, MapResult)
    results: dict[Any, MapResult]
    if isinstance(result, Mapping):
        results = dict(result)
    else:
        results = dict(enumerate(result if isinstance(result, Sequence) else [result]))
    if not results:
        raise ValueError("there are no results to draw")
    for one in results.values():
        check_instance("result", one, MapResult)
        if not one.history:
            raise ValueError("the result has no history to draw")
    figure = new_figure((8, 4.5))
    energy, flips = figure.add_axes((0.09, 0.45, 0.88, 0.5)), figure.add_axes((0.09, 0.12, 0.88, 0.26))
    last = 1
    for place, (label, one) in enumerate(results.items()):
        begin = 0
        for number, (name, steps) in enumerate(_runs(one)):
            at = begin + np.arange(len(steps))
            values = np.array([step.energy for step in steps])
            values[~(np.isfinite(values) & (values > 0))] = np.nan
            color = _COLORS[(place if several else number) % len(_COLORS)]
            # The legend lists the runs of one result, or several results.
            shown = name if not several else "" if number else str(label)
            energy.plot(at, values, ".-", color=color, markersize=4, linewidth=1.4, label=shown)
            many = [step.inverted for step in steps]
            flips.plot(at, many, ".-", color=color if several else RED, markersize=4, linewidth=1.2)
            # The next run starts from the last map of this run.
            begin += len(steps) - 1
        last = max(last, begin)
    if np.isfinite(np.concatenate([line.get_ydata() for line in energy.lines])).any():
        energy.set_yscale("log")
    flips.set_yscale("symlog", linthresh=1)
    flips.set_ylim(0, 2 * max(1, max(step.inverted for one in results.values() for step in one.history)))
    for ax, x, y in ((energy, "", "energy"), (flips, "iterations", "inverted")):
        name_axes(ax, x, y)
        ax.set_xlim(0, last)
    energy.tick_params(labelbottom=False)
    flips.xaxis.set_major_locator(MaxNLocator(integer=True))
    energy.legend(frameon=False, fontsize=9)
    return figure


def _runs(result: MapResult) -> list[tuple[str, Sequence[Step]]]:
    """Return the runs of the history with the names of their stages; iterations count from 0 in each run."""
    starts = [k for k, step in enumerate(result.history) if k == 0 or step.iteration == 0]
    runs: list[tuple[str, Sequence[Step]]] = []
    stages = list(result.stages)
    for first, last in pairwise([*starts, len(result.history)]):
        names: list[str] = []
        left = last - first - 1
        while stages and (left > 0 or not names):
            left -= stages[0].n_iterations
            names.append(stages.pop(0).name)
        name = names[0] if len(names) == 1 else f"{len(names)} stages, the last {names[-1]}" if names else "run"
        runs.append((name, result.history[first:last]))
    return runs
