"""Flatten one chart with a free boundary, and measure its stretch.

The symmetric Dirichlet energy is a mean, so it accepts much stretch in few triangles. If more of the chart than allowed
is stretched beyond the bound, the descent continues with `EvenStretch`, which weights large stretch more. Both take
Newton's steps far from the minimum, and quasi-Newton steps near it. The boundary is not guarded against overlaps. A
chart that overlaps itself is divided by the caller, which also lowers its stretch.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quasiharmonic.apps.flattening.flattening_run import Flattening
from quasiharmonic.apps.flattening.piece import Piece
from quasiharmonic.apps.flattening.surface_descent import SurfaceDescent, descend
from quasiharmonic.apps.flattening.worst_triangles import descend_on_patches
from quasiharmonic.apps.unwrapping.chart_starts import find_initial_map
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import Energy, Hardened, SymmetricDirichlet
from quasiharmonic.energies.newton.distant_starts import ReweightedDirichlet
from quasiharmonic.energies.newton.laplacian_descent import LaplacianDescent
from quasiharmonic.energies.newton.map_model import in_units
from quasiharmonic.geometry.exact.loops import check_loops
from quasiharmonic.geometry.mesh.reference import corner_angles, rest_shapes
from quasiharmonic.linsolve import NotPositiveDefinite, available
from quasiharmonic.util.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from quasiharmonic.util.options import FlattenOptions

#: No triangle may be stretched more than this, except triangles with a smaller angle than `THIN_ANGLE`.
WORST_STRETCH = 3.0
#: Angle in radians below which the stretch of a triangle is not bounded.
THIN_ANGLE = np.pi / 180
#: Share of the area that may be stretched beyond the bound.
FREE_SHARE = 0.01


class ChartTuning(NamedTuple):
    """Numbers that tune the descents of charts. Energies are means over the surface."""

    # Relative tolerance of the descents: a more accurate minimum hardly changes the stretch.
    tolerance: float = 1e-2
    max_steps: int = 100
    # A descent ends after a step that lowers the energy by less than this share: further steps change the stretch
    # little.
    slow: float = 0.05
    # A mean energy below this needs no further steps.
    nothing: float = 1e-5
    # Smallest energy at the bound that `EvenStretch` uses.
    least_energy: float = 0.1
    # Number of quasi-Newton steps that count as one step.
    window: int = 5
    # ``slow`` and ``window`` of a first descent, which usually only prepares the descent of another energy.
    slow_at_first: float = 0.3
    window_at_first: int = 3
    # From mean energies below this, quasi-Newton steps are used.
    near: float = 3.0
    # Charts with at most this number of vertices get the linear solver for small systems. It takes half the time there,
    # though more than others for compact meshes of this size.
    narrow: int = 5_000
    # Boundary vertices are rounded to this multiple of the root of the area before contacts are sought.
    gap: float = 2.0**-20


_TUNING = ChartTuning()


class EvenStretch(Hardened):
    """``E + k E³`` with the symmetric Dirichlet energy E: few triangles with large stretch are worse than many.

    Parameters
    ----------
    bound : float
        Above 1. Where one singular value has this stretch and the other is 1, the second term is three times the first.
    linear : bool
        Whether the energy is linear in E beyond there. Then a few triangles that stay stretched, such as thin ones, do
        not outweigh the rest of the chart. Otherwise its descent ends before the rest is at its minimum.
    """

    def __init__(self, bound: float, *, linear: bool = True) -> None:
        energy = max((bound - 1 / bound) ** 2, _TUNING.least_energy)
        super().__init__(SymmetricDirichlet(), 3 / energy**2, energy if linear else np.inf)


@dataclass(eq=False)
class WorkingChart:
    """A chart during the search.

    Attributes
    ----------
    triangles : (k,) int64
        Rows of the mesh's triangles.
    vertices : (m,) int64
        Vertices of the mesh; a vertex on a cut can occur several times.
    V : (m, 3) float64
    F : (k, 3) int64
        The triangles, by the chart's own vertices.
    cost : (k, 3) float64
        Factor on the cost of cutting each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0.
    uv : (m, 2) float64 or None
        An injective map, in the unit of `piece`, or None.
    stretch : (k,) float64
        The larger of σ₁ and 1/σ₂ on each triangle, if the map has the surface's area; infinite without a map.
    """

    triangles: IntArray
    vertices: IntArray
    V: FloatArray
    F: IntArray
    cost: FloatArray
    uv: FloatArray | None = None
    stretch: FloatArray = field(default_factory=lambda: np.empty(0))
    # An injective map from which the first descent starts, if there is a good one.
    start: FloatArray | None = None
    # Number of successive extensions of cuts that lowered the stretch too little.
    failures: int = 0
    # The value of `crossings` and `bijective`, once they have been asked for.
    _contacts: tuple[IntArray, bool] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.piece = Piece(self.V, self.F)
        shapes = rest_shapes(self.piece.V, self.F)
        self.area: FloatArray = shapes.m / shapes.m.sum()
        self.surface_area = float(np.ldexp(self.piece.area, 2 * self.piece.exponent))

    @cached_property
    def _thin(self) -> BoolArray:
        """Mask (k,) of the triangles with a small angle, on which the stretch has no bound."""
        return smallest_angles(rest_shapes(self.piece.V, self.F).sides) < THIN_ANGLE

    def over(self, bound: float) -> BoolArray:
        """Mask (k,) of the triangles that are stretched beyond the bound."""
        return self.stretch > bound

    def share_over(self, bound: float) -> float:
        """Share of the area that is stretched beyond the bound."""
        return float(self.area[self.over(bound)].sum())

    @property
    def linear_solver(self) -> str:
        """The linear solver for systems of the chart: charts are narrow, so small ones have little fill."""
        return "qdldl" if len(self.V) <= _TUNING.narrow and available(0)[0] == "qdldl" else "auto"

    @property
    def too_long(self) -> BoolArray:
        """Mask (k,) of the triangles that are stretched beyond `WORST_STRETCH` although they are not thin."""
        stretched = self.stretch > WORST_STRETCH
        return ~self._thin & stretched if stretched.any() else stretched

    @property
    def crossings(self) -> IntArray:
        """Pairs (c, 4) of boundary edges that intersect or almost touch."""
        return self._find_contacts()[0]

    @property
    def bijective(self) -> bool:
        """Whether the map covers no point twice, and its boundary stays away from itself; False without a map."""
        return self._find_contacts()[1]

    def _find_contacts(self) -> tuple[IntArray, bool]:
        if self.uv is None or not self.stretch.size:
            return np.empty((0, 4), dtype=np.int64), False
        if self._contacts is None:
            # Boundaries that are closer than this would touch in the precision of texture coordinates.
            unit = _TUNING.gap * np.sqrt(self.piece.area)
            crossings, reasons = check_loops(self.piece.loops, np.rint(self.uv / unit) * unit)
            self._contacts = crossings, not reasons
        return self._contacts

    def use(self, uv: FloatArray) -> None:
        """Use an injective map (m, 2), scaled to the surface's area, and measure its stretch."""
        self.uv = self.piece.fit_scale(uv)
        self.stretch = measure_stretch(self.piece.energy(SymmetricDirichlet(), None), self.uv)
        self._contacts = None


def smallest_angles(sides: ComplexArray) -> FloatArray:
    """Smallest angle (f,) in radians of triangles given by their sides (3, f) complex128."""
    length = np.abs(sides)
    with np.errstate(all="ignore"):
        angles = corner_angles(sides)
    return np.where(length.min(axis=0) > 0, angles.min(axis=1), 0.0)


def measure_stretch(energy: DeformationEnergy, uv: FloatArray) -> FloatArray:
    """The larger of σ₁ and 1/σ₂ (f,) on each triangle after scaling a map (n, 2) to the surface's area."""
    d = energy.deform(in_units(uv, 0))
    larger = np.abs(d.p) + np.abs(d.q)
    with np.errstate(all="ignore"):
        scale = 1 / np.sqrt((energy.share * d.det).sum() / energy.share.sum())
        return np.maximum(scale * larger, larger / (scale * d.det))


def flatten_chart(chart: WorkingChart, bound: float, check_wanted: Callable[[], object]) -> None:
    """Flatten a chart, from its map if it has one; afterwards its map may overlap itself.

    ``check_wanted`` is called before every step and may raise an exception. If no injective map is found in double
    precision, the chart has no map.
    """
    if chart.uv is None:
        flat = chart.piece.planar_map()
        uv = flat if flat is not None else chart.start
        if uv is None:
            uv = find_initial_map(chart.piece, chart.linear_solver)
        if uv is None:
            chart.stretch = np.full(len(chart.F), np.inf)
            return
        chart.use(uv)
        if chart.start is not None:
            _relax_long(chart, bound)
        if flat is None and (chart.start is None or chart.too_long.any()):
            _descend(chart, SymmetricDirichlet(), check_wanted, at_first=True)
            if keeps_bound(chart, bound):
                _descend(chart, SymmetricDirichlet(), check_wanted)
            _relax_long(chart, bound)
        if keeps_bound(chart, bound):
            return
    else:
        chart.use(chart.uv)
        if keeps_bound(chart, bound) and chart.bijective:
            return
    _descend(chart, EvenStretch(bound), check_wanted)
    _relax(chart, bound, chart.too_long)


def guard_chart(chart: WorkingChart, check_wanted: Callable[[], object]) -> None:
    """Flatten a chart that must not overlap itself; slower than `flatten_chart` and with more stretch."""
    settings = FlattenOptions(
        tol=_TUNING.tolerance, max_iterations=_TUNING.max_steps, callback=lambda _: check_wanted()
    )
    result = Flattening(chart.piece, settings, None).run(None)
    chart.use(result.uv)


def keeps_bound(chart: WorkingChart, bound: float) -> bool:
    """Whether a chart on its own keeps the bound."""
    return chart.share_over(bound) <= FREE_SHARE and not chart.too_long.any()


@np.errstate(all="ignore")
def _descend(
    chart: WorkingChart, density: Energy, check_wanted: Callable[[], object], *, at_first: bool = False
) -> None:
    """Lower an energy of the chart's map, which stays injective.

    ``at_first`` ends the quasi-Newton steps earlier, since another descent follows.
    """
    assert chart.uv is not None
    try:
        if _approach(chart, density, _TUNING.near, check_wanted):
            slow, window = _TUNING.slow, _TUNING.window
            if at_first:
                slow, window = _TUNING.slow_at_first, _TUNING.window_at_first
            _finish(chart, density, check_wanted, slow, window)
    except NotPositiveDefinite:
        # Newton's system can be made positive definite where rounding prevents that for the Laplacian.
        _approach(chart, density, _TUNING.nothing, check_wanted)
    finally:
        # After a time limit, the chart has the map so far.
        chart.use(chart.uv)


def _approach(chart: WorkingChart, density: Energy, near: float, check_wanted: Callable[[], object]) -> bool:
    """Take Newton's steps until the mean energy is at most ``near``; return False if they become slow before."""
    assert chart.uv is not None
    energy = chart.piece.energy(density, None)
    before = energy.value(in_units(chart.uv, 0))
    if before <= near:
        return True
    if isinstance(density, SymmetricDirichlet) and before > _TUNING.near:
        energy = energy.with_density(ReweightedDirichlet())
    descent = SurfaceDescent(energy, chart.uv, chart.linear_solver)
    for _ in itertools.islice(descend(descent, density, _TUNING.tolerance), _TUNING.max_steps):
        chart.uv = descent.uv
        check_wanted()
        if descent.distortion <= near:
            return True
        if descent.distortion > (1 - _TUNING.slow) * before:
            return False
        before = descent.distortion
    return False


def _finish(chart: WorkingChart, density: Energy, check_wanted: Callable[[], object], slow: float, window: int) -> None:
    """Take quasi-Newton steps until ``window`` of them lower the energy by less than the share ``slow``."""
    assert chart.uv is not None
    descent = LaplacianDescent(chart.piece.energy(density, None), chart.uv, chart.linear_solver)
    values = [descent.value]
    while len(values) <= _TUNING.max_steps and values[-1] >= _TUNING.nothing and descent.step():
        chart.uv = descent.uv
        check_wanted()
        if len(values) >= window and descent.value > (1 - slow) * values[-window]:
            break
        values.append(descent.value)


def _relax_long(chart: WorkingChart, bound: float) -> None:
    """Lower the stretch around triangles that are stretched too much, with the rest of the map fixed.

    Without effect where too much of the chart exceeds the bound, so that all of the map must change.
    """
    if chart.share_over(bound) <= FREE_SHARE:
        _relax(chart, bound, chart.too_long)


def relax_thin(chart: WorkingChart, bound: float) -> None:
    """Lower the stretch around thin triangles that quasi-Newton steps leave stretched, if the map stays bijective."""
    before = chart.uv
    if before is None or not chart.bijective or not chart.over(WORST_STRETCH).any():
        return
    share, worst = chart.share_over(bound), float(chart.stretch.max())
    _relax(chart, bound, chart.over(WORST_STRETCH))
    if not chart.bijective or chart.too_long.any() or chart.share_over(bound) > share or chart.stretch.max() > worst:
        chart.use(before)


def _relax(chart: WorkingChart, bound: float, long: BoolArray) -> None:
    """Lower the stretch around some triangles (k,), if there are any, with the rest of the map fixed."""
    assert chart.uv is not None
    if not long.any():
        return
    density = EvenStretch(bound, linear=False)
    moved = descend_on_patches(chart.piece.energy(density, None), density, chart.uv, long, chart.linear_solver)
    if moved is not None:
        chart.use(moved)
