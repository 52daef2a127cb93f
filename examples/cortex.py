"""A human cortex flattened
===========================

The left half of FreeSurfer's fsaverage5 (nilearn), flattened by ``flatten`` and ``keep_distances``, beside its
published flat map. Top: sulcal depth; bottom: cuts, and distance errors.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from numpy.typing import NDArray

from common import INK, RED, FloatArray, colorbar, panels, run, save
from quasiharmonic import certify, distortion, flatten, keep_distances
from quasiharmonic.energies.distances import SurfaceDistances, surface_distances
from quasiharmonic.geometry.mesh.topology import boundary_edges
from quasiharmonic.ui.plot.canvas import shade
from quasiharmonic.util.arrays import IntArray

# Colours from the crowns of the gyri to the bottoms of the sulci.
DEPTH = LinearSegmentedColormap.from_list("depth", [(0.98, 0.86, 0.55), (0.93, 0.93, 0.90), (0.16, 0.30, 0.55)])
WALL = (0.80, 0.80, 0.82)


class Cortex(NamedTuple):
    """The patch of the hemisphere that is flattened, and the whole hemisphere for display.

    Attributes
    ----------
    V, F
        The patch.
    published : (n, 2) float64
    depth : (n,) float64
        Sulcal depth.
    number : (n,) int64
        Indices of the patch's vertices in the whole hemisphere.
    inflated, whole
        The vertices of the whole inflated hemisphere, and its triangles.
    """

    V: FloatArray
    F: IntArray
    published: FloatArray
    depth: FloatArray
    number: IntArray
    inflated: FloatArray
    whole: IntArray


def cortex() -> Cortex:
    """Read the left hemisphere from the files of the installed package nilearn."""
    import nibabel
    from nilearn.datasets import fetch_surf_fsaverage

    files = fetch_surf_fsaverage("fsaverage5")

    def arrays(name: str) -> list[NDArray[Any]]:
        return [array.data for array in nibabel.load(files[name]).darrays]

    (white, whole), (flat, patch) = arrays("white_left"), arrays("flat_left")
    number, F = np.unique(patch.astype(np.int64), return_inverse=True)
    return Cortex(
        V=white[number].astype(np.float64),
        F=F.reshape(-1, 3),
        published=flat[number, :2].astype(np.float64),
        depth=arrays("sulc_left")[0][number].astype(np.float64),
        number=number,
        inflated=arrays("infl_left")[0].astype(np.float64),
        whole=whole.astype(np.int64),
    )


def by_autoflatten(brain: Cortex) -> FloatArray:
    """The map computed by autoflatten, exchanged through FreeSurfer's files."""
    from nibabel.freesurfer import write_geometry

    kind = np.dtype([("vertex", ">i4"), ("place", ">f4", 3)])
    rows = np.zeros(len(brain.V), dtype=kind)
    # Vertex numbers start at one; those of boundary vertices are negative.
    rows["vertex"], rows["place"] = brain.number + 1, brain.V
    rows["vertex"][np.unique(boundary_edges(brain.F, len(brain.V)))] *= -1
    with TemporaryDirectory() as folder:
        surface, patch, flat = (str(Path(folder, name)) for name in ("lh.fiducial", "lh.patch.3d", "lh.flat.patch.3d"))
        everywhere = np.zeros((len(brain.inflated), 3))
        everywhere[brain.number] = brain.V
        # autoflatten finds the cuts from missing triangles, so the surface contains only the patch's.
        write_geometry(surface, everywhere, brain.number[brain.F])
        Path(patch).write_bytes(np.array([-1, len(rows)], dtype=">i4").tobytes() + rows.tobytes())
        program = str(Path(sys.executable).with_name("autoflatten"))
        subprocess.run(
            [program, "flatten", patch, "--base-surface", surface, "-o", flat], check=True, stdout=subprocess.DEVNULL
        )
        found = np.frombuffer(Path(flat).read_bytes()[8:], dtype=kind)
    uv = np.zeros((len(brain.inflated), 2))
    uv[np.abs(found["vertex"]) - 1] = found["place"][:, :2]
    return uv[brain.number]


def show_surface(ax: Axes, brain: Cortex, side: int, color: FloatArray, *, cuts: bool) -> None:
    """Draw the inflated hemisphere from outside (-1) or from the medial side (1), with the patch in its colours."""
    seen = brain.inflated[:, 1] * side
    points, towards = np.stack([seen, brain.inflated[:, 2]], axis=1), side * brain.inflated[:, 0]
    corners = brain.inflated[brain.whole]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    light = normal @ (np.array([side * 0.75, -side * 0.25, 0.6]) / np.linalg.norm((0.75, 0.25, 0.6)))
    hue = np.tile(WALL, (len(brain.whole), 1))
    order = {tuple(triangle): k for k, triangle in enumerate(np.sort(brain.number[brain.F], axis=1).tolist())}
    place = np.array([order.get(tuple(triangle), -1) for triangle in np.sort(brain.whole, axis=1).tolist()])
    hue[place >= 0] = color[place[place >= 0]]
    front = np.flatnonzero(side * normal[:, 0] > 0)
    front = front[np.argsort(towards[brain.whole[front]].mean(axis=1))]
    shades = shade(hue, light)[front]
    ax.add_collection(PolyCollection(points[brain.whole[front]], facecolors=shades, edgecolors="face", lw=0.3))
    if cuts:
        ends = brain.number[boundary_edges(brain.F, len(brain.V))]
        visible = np.isin(ends, brain.whole[front]).all(axis=1)
        ax.add_collection(LineCollection(points[ends[visible]], colors=[RED], lw=1.2))
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()


def show_map(ax: Axes, brain: Cortex, uv: FloatArray, color: FloatArray) -> None:
    """Draw a flat map, rotated like the published one, in the colours of its triangles."""
    w, like = uv @ (1, 1j), brain.published @ (1, 1j)
    w, like = w - w.mean(), like - like.mean()
    turn = np.vdot(w, like)
    w *= turn / abs(turn) * np.sqrt(np.vdot(like, like).real / np.vdot(w, w).real)
    points = np.stack([w.real, w.imag], axis=1)
    ax.add_collection(PolyCollection(points[brain.F], facecolors=color, edgecolors="face", lw=0.3))
    ends = boundary_edges(brain.F, len(points))
    ax.add_collection(LineCollection(points[ends], colors=[INK], lw=0.6))
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()


def around_vertices(sample: SurfaceDistances, uv: FloatArray) -> FloatArray:
    """The mean error of the pairs of each vertex, (n,) float64."""
    off = np.abs(sample.error(uv).relative)
    return np.bincount(sample.target, off, len(uv)) / np.maximum(np.bincount(sample.target, minlength=len(uv)), 1)


def subdivide(V: FloatArray, F: IntArray) -> tuple[FloatArray, IntArray]:
    """Split each triangle into four at the midpoints of its sides: the same surface with twice as many rings."""
    sides = np.sort(np.stack([F, np.roll(F, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    ends, middle = np.unique(sides, axis=0, return_inverse=True)
    ab, bc, ca = (len(V) + middle.reshape(-1, 3)).T
    a, b, c = F.T
    parts = (a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)
    return np.concatenate([V, V[ends].mean(axis=1)]), np.concatenate([np.stack(part, axis=1) for part in parts])


def main(output: Path, rings: int = 20, autoflatten: bool = False, subdivided: bool = False) -> dict[str, Any]:
    brain = cortex()
    maps: dict[str, tuple[FloatArray, float | None]] = {"published": (brain.published, None)}
    if autoflatten:
        began = time.perf_counter()
        uv = by_autoflatten(brain)
        maps["autoflatten"] = uv, time.perf_counter() - began
    plain = flatten(brain.V, brain.F)
    kept = keep_distances(brain.V, brain.F, plain.uv, rings=rings)
    maps["symmetric Dirichlet"] = plain.uv, plain.seconds
    maps["distances"] = kept.uv, plain.seconds + kept.seconds

    sample = surface_distances(brain.V, brain.F, rings=rings, sources=len(brain.V), targets=150)
    depth = DEPTH(Normalize(*np.quantile(brain.depth, (0.02, 0.98)))(brain.depth[brain.F].mean(axis=1)))[:, :3]
    errors = ScalarMappable(Normalize(0, 40), "magma_r")
    figure, axes = panels(2, len(maps) + 1, (3.6, 3.5))
    show_surface(axes[0][0], brain, -1, depth, cuts=False)
    show_surface(axes[1][0], brain, 1, depth, cuts=True)
    axes[0][0].set_title("the cortex, from outside", size=11)
    axes[1][0].set_title("from the middle, with the cuts", size=11)
    numbers: dict[str, Any] = {}
    for k, (name, (uv, seconds)) in enumerate(maps.items(), 1):
        error, judged = sample.error(uv), certify(brain.F, uv)
        show_map(axes[0][k], brain, uv, depth)
        around = around_vertices(sample, uv)[brain.F].mean(axis=1)
        show_map(axes[1][k], brain, uv, errors.to_rgba(100 * around)[:, :3])
        took = "" if seconds is None else f", {seconds:.1f} s"
        axes[0][k].set_title(f"{name}{took}", size=11)
        inverted = judged.inverted.size + judged.degenerate.size
        axes[1][k].set_title(
            f"distances {100 * error.mean:.1f} % off, {'bijective' if judged.bijective else f'{inverted} inverted'}",
            size=11,
            color=INK if judged.bijective else RED,
        )
        symmetric = distortion(brain.V, brain.F, uv).statistics("symmetric_dirichlet").mean
        numbers[name] = {
            "seconds": seconds,
            "symmetric Dirichlet": symmetric if np.isfinite(symmetric) else None,
            "distance error, mean": error.mean,
            "distance error, rms": error.rms,
            "inverted": inverted,
            "bijective": judged.bijective,
        }
    if subdivided:
        V, F = subdivide(*subdivide(brain.V, brain.F))
        flat = flatten(V, F, energy="distances", rings=rings)
        error = surface_distances(V, F, rings=rings, sources=1500, targets=200).error(flat.uv)
        numbers["subdivided"] = {
            "triangles": len(F),
            "seconds": flat.seconds,
            "symmetric Dirichlet": distortion(V, F, flat.uv).statistics("symmetric_dirichlet").mean,
            "distance error, mean": error.mean,
            "distance error, rms": error.rms,
            "bijective": flat.certificate.bijective,
        }
    colorbar(figure, errors, "distances around a vertex off by %")
    save(figure, output, "cortex")
    return {"triangles": len(brain.F), "pairs": sample.length.size, **numbers}


if __name__ == "__main__":
    run(main)
