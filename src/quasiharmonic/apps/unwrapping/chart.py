"""A chart, a part of a surface with a bijective map into the plane, and the mirror images of charts."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quasiharmonic.apps.atlas.packing.pack import find_copies
from quasiharmonic.apps.atlas.packing.shapes import Shape, make_shape
from quasiharmonic.apps.unwrapping.chart_maps import WorkingChart
from quasiharmonic.apps.unwrapping.symmetry import Mirror
from quasiharmonic.geometry.mesh.reference import area_vectors
from quasiharmonic.geometry.mesh.splitting import NO_CUT, renumber, split_parts
from quasiharmonic.geometry.mesh.topology import components, group_by_label
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, scale_to_unit
from quasiharmonic.util.progress import heartbeat

# Areas and moments of congruent components have at most this relative difference.
_SAME_MEASURES = 1e-4


@dataclass(frozen=True, eq=False)
class Chart:
    """A part of a surface with a bijective map into the plane.

    Attributes
    ----------
    triangles : (k,) int64
        Rows of the mesh's triangles, ascending.
    F : (k, 3) int64
        The same triangles, by the chart's own vertices.
    vertices : (m,) int64
        Vertices of the mesh. A vertex on a cut can occur several times.
    uv : (m, 2) float64
        Positions in the surface's unit of length; the chart has the area of its part of the surface.
    stretch : (k,) float64
        The larger of σ₁ and 1/σ₂ of each triangle.
    misses : float
        How much the chart exceeds the bound on stretch; 0 if all charts together keep it. It is the larger of two
        differences: between the 99 % quantile by area and ``max_stretch``, and between the largest stretch and 3.
    straight : bool
        Whether the chart is a strip that was made a rectangle, or a part of it.
    """

    triangles: IntArray
    F: IntArray
    vertices: IntArray
    uv: FloatArray
    stretch: FloatArray
    misses: float
    straight: bool = False

    @cached_property
    def shape(self) -> Shape:
        """The part of the plane that the chart covers."""
        heartbeat()
        return make_shape(self.uv, self.F)

    @property
    def isometric(self) -> bool:
        """Whether the chart has no stretch."""
        return bool((self.stretch == 1).all())

    def take(self, rows: IntArray) -> list[Chart]:
        """Return the connected parts of some triangles, by their places (k,) in the chart, as charts."""
        return [
            replace(
                self,
                triangles=self.triangles[some],
                F=own,
                vertices=self.vertices[origin],
                uv=self.uv[origin],
                stretch=self.stretch[some],
            )
            for some, own, origin in split_parts(self.F[rows], rows, NO_CUT, len(self.uv))
        ]

    def split(self, first: BoolArray) -> list[Chart]:
        """Return the connected parts of the triangles in a mask (k,), and those of the others, as charts."""
        return [*self.take(np.flatnonzero(first)), *self.take(np.flatnonzero(~first))]

    def open(self, V: FloatArray, cost: FloatArray) -> WorkingChart:
        """Return the chart for further cuts, given positions (n, 3) and costs (f, 3) of the whole mesh."""
        rows = self.triangles
        working = WorkingChart(rows, self.vertices, V[self.vertices], self.F, cost[rows])
        working.uv, working.stretch = np.ldexp(self.uv, -working.piece.exponent), self.stretch
        return working

    def part(self, working: WorkingChart, bound: float) -> Chart:
        """Return a part of the chart, which was cut off with its map."""
        assert working.uv is not None
        stretch = self.stretch[np.searchsorted(self.triangles, working.triangles)]
        uv = np.ldexp(working.uv, working.piece.exponent)
        missed = self.misses if (stretch > bound).any() else 0.0
        return Chart(working.triangles, working.F, working.vertices, uv, stretch, missed, self.straight)


def cut_out_chart(
    triangles: IntArray, split: IntArray, F: IntArray, corner_uv: FloatArray, stretch: FloatArray, misses: float = 0.0
) -> Chart:
    """Return triangles F (k, 3), ``split`` as by `fans`, with positions (k, 3, 2) in the plane, as a chart."""
    own, corner = renumber(split, F)
    return Chart(triangles, own, F.ravel()[corner], corner_uv.reshape(-1, 2)[corner], stretch, misses)


def halve(corner_uv: FloatArray) -> BoolArray:
    """Return a mask (k,) of one half of triangles (k, 3, 2) in the plane, along their longer extent."""
    centre = corner_uv.mean(axis=1)
    along = centre[:, np.argmax(np.ptp(centre, axis=0))]
    return np.asarray(np.argsort(np.argsort(along, kind="stable")) < len(along) // 2)


def finish_chart(chart: WorkingChart, misses: float) -> Chart:
    """Return a chart with its map in the surface's unit, given how much it exceeds the bound on stretch."""
    assert chart.uv is not None
    uv = np.ldexp(chart.uv, chart.piece.exponent)
    return Chart(chart.triangles, chart.F, chart.vertices, uv, chart.stretch, misses)


def mirror_charts(F: IntArray, charts: list[Chart], mirror: Mirror) -> list[Chart]:
    """Return charts of one side of the plane of symmetry, and their images."""
    return [*charts, *(_mirror(F, chart, mirror) for chart in charts)]


def number_kinds(
    charts: list[Chart], stack: bool | str, mirror: Mirror | None, V: FloatArray, F: IntArray
) -> list[int] | None:
    """Return a number for each chart, the same for charts that may share texture coordinates; None if none do.

    ``stack`` is the option of `unwrap`; ``V`` (n, 3) and ``F`` (f, 3) are the whole surface.
    """
    if not stack:
        return None
    return _pair_charts(charts, mirror) if stack == "mirrored" else _number_copies(charts, V, F)


def _pair_charts(charts: list[Chart], mirror: Mirror | None) -> list[int]:
    """Return a number for each chart that it shares with its mirror image only; charts without one have their own."""
    owner = {chart.triangles.tobytes(): k for k, chart in enumerate(charts)}
    if mirror is None:
        return list(range(len(charts)))
    images = [owner.get(np.sort(mirror.triangle[chart.triangles]).tobytes(), k) for k, chart in enumerate(charts)]
    return [min(k, image) for k, image in enumerate(images)]


def _number_copies(charts: list[Chart], V: FloatArray, F: IntArray) -> list[int]:
    """Return a number for each chart, the same only for charts of different components that are congruent.

    Components count as congruent if they have equal numbers of triangles, areas, and moments. Congruent charts of one
    component have different numbers.
    """
    label, kinds = _number_components(V, F)
    # Of congruent charts of a component, the k-th is stacked with the k-th of other components.
    same = find_copies([(chart.uv, chart.F) for chart in charts])
    ranks, numbers = Counter[tuple[int, int]](), dict[tuple[int, int, int], int]()
    found = []
    for k, chart in enumerate(charts):
        component = int(label[chart.triangles[0]])
        shape = same[k].original if k in same else k
        key = kinds[component], shape, ranks[component, shape]
        ranks[component, shape] += 1
        found.append(numbers.setdefault(key, len(numbers)))
    return found


def _number_components(V: FloatArray, F: IntArray) -> tuple[IntArray, dict[int, int]]:
    """Return the component (f,) of each triangle, and the first congruent component for each one; see above."""
    label = components(F, len(V))[F[:, 0]]
    # In this unit, products neither overflow nor underflow.
    V = scale_to_unit(V)
    area, centre = np.linalg.norm(area_vectors(V, F), axis=1), V[F].mean(axis=1)
    kinds = dict[int, int]()
    known = defaultdict[int, list[tuple[int, FloatArray]]](list)
    for rows in group_by_label(label):
        whole, away = area[rows].sum(), centre[rows] - centre[rows].mean(axis=0)
        moments = np.linalg.eigvalsh(np.einsum("k,ki,kj->ij", area[rows], away, away))
        measures = np.array([whole, *np.sqrt(np.maximum(moments, 0) * whole)])
        near = _SAME_MEASURES * measures.max()
        alike = known[len(rows)]
        same_kind = (kind for kind, other in alike if np.abs(other - measures).max() <= near)
        component = int(label[rows[0]])
        kinds[component] = next(same_kind, component)
        if kinds[component] == component:
            alike.append((component, measures))
    return label, kinds


def find_textures(
    tile: IntArray | None, stack: bool | str, mirror: Mirror | None, V: FloatArray, F: IntArray
) -> IntArray:
    """Return the texture (f,) of each triangle: its ``tile`` if given, 0 without; -1 if it is stacked on another."""
    if tile is not None or not stack:
        return np.zeros(len(F), dtype=np.int64) if tile is None else tile
    if stack == "mirrored":
        copies = np.zeros(len(F), dtype=np.bool_) if mirror is None else mirror.positive[mirror.triangle]
    else:
        label, kinds = _number_components(V, F)
        copies = np.array([kinds[component] != component for component in label.tolist()], dtype=np.bool_)
    return np.where(copies, -1, 0)


def group_charts(charts: Sequence[Chart], texture: IntArray) -> list[list[Chart]]:
    """Return the charts of each texture without copies, given the result (f,) of `find_textures`."""
    groups = defaultdict[int, list[Chart]](list)
    for chart in charts:
        groups[int(texture[chart.triangles].max())].append(chart)
    return [group for k, group in sorted(groups.items()) if k >= 0]


def measure_fullest(charts: Sequence[Chart], texture: IntArray) -> float:
    """Return the area of the charts of the texture that has most of it; see `group_charts`."""
    return max(map(measure_charts, group_charts(charts, texture)), default=0.0)


def measure_charts(charts: Sequence[Chart]) -> float:
    """Return the area of charts in the plane."""
    return sum(chart.shape.area for chart in charts)


def _mirror(F: IntArray, chart: Chart, mirror: Mirror) -> Chart:
    """Return the mirror image of a chart."""
    rows = mirror.triangle[chart.triangles]
    # The corner of the original for each corner of its image.
    original = mirror.vertex[F[chart.triangles]]
    corner = np.argmax(F[rows][:, :, None] == original[:, None, :], axis=2)
    own = np.take_along_axis(chart.F, corner, axis=1)
    order = np.argsort(rows)
    return Chart(
        rows[order], own[order], mirror.vertex[chart.vertices], chart.uv * [-1, 1], chart.stretch[order], chart.misses
    )
