"""The result of `unwrap`: texture coordinates with seams, their certificate, and how much they stretch the surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quasiharmonic.apps.inverse_map import ChartInverse
from quasiharmonic.apps.unwrapping.chart_verdict import UnwrapCertificate
from quasiharmonic.apps.unwrapping.straightening import Strip
from quasiharmonic.apps.unwrapping.symmetry import Symmetry, describe_symmetry
from quasiharmonic.io.objects import make_trimesh
from quasiharmonic.problem.inspection import describe_soup
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, count_of, find_exponent, names_of
from quasiharmonic.util.outcome import Displayable, Outcome, as_plain, replace_nonfinite

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from trimesh import Trimesh

    from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh

# Maximum number of charts that the summary lists.
_LISTED = 5


class UnwrapStatus(Enum):
    """How `unwrap` ended; the value is a message for the user with the outcome and the next action.

    See Also
    --------
    UnwrapResult : Has a status, and the message of it.
    Status : The statuses of other maps.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.results import UnwrapStatus
    >>> from quasiharmonic.surfaces import starfish
    >>> unwrap(*starfish(3, 4)).status is UnwrapStatus.UNWRAPPED
    True
    """

    UNWRAPPED = "Every chart is bijective and no two charts overlap, verified exactly. The stretch is within the bound."
    STRETCHED = (
        "Every chart is bijective and no two charts overlap, verified exactly. Some charts are stretched by more "
        "than the bound: see misses. They need more seams: permit more charts with max_charts, or a larger "
        "max_stretch. In a lightmap, the sides of charts become whole texels, at least two: use a higher resolution or "
        "density."
    )
    TIME_LIMIT = (
        "Every chart is bijective and no two charts overlap, verified exactly. The time limit ended the search for few "
        "charts: see unfinished. Allow more time."
    )
    KEPT_FAULTS = (
        "Every new chart is bijective and overlaps no sound chart, verified exactly. Some kept charts are not "
        "bijective or overlap each other: see certificate. Add their triangles to faces to replace them."
    )


def find_status(certificate: UnwrapCertificate, misses: list[Miss], ended: bool) -> UnwrapStatus:
    """Return the status of a result in which all new charts are bijective; ``ended`` by the time limit or not."""
    if not certificate.bijective:
        return UnwrapStatus.KEPT_FAULTS
    if ended:
        return UnwrapStatus.TIME_LIMIT
    return UnwrapStatus.STRETCHED if misses else UnwrapStatus.UNWRAPPED


class Stretch(NamedTuple):
    """Stretch max(σ₁, 1/σ₂) of a map after one scaling of all charts; quantiles are weighted by area.

    Attributes
    ----------
    median, p99, worst : float
        Half and 99 % of the surface are stretched by at most this factor, and the maximum over all triangles. NaN if
        all triangles are too thin to be measured.

    See Also
    --------
    UnwrapResult : Has the stretch of all charts.
    distortion : Other measures, for each triangle.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> stretch = unwrap(*starfish(3, 4)).stretch
    >>> bool(1 <= stretch.median <= stretch.p99 <= stretch.worst)
    True
    """

    median: float
    p99: float
    worst: float


class Miss(NamedTuple):
    """A chart that exceeds the bound on the stretch.

    Attributes
    ----------
    chart : int
    stretch : Stretch
        The chart's own stretch.
    excess : float
        The larger of two differences: between the 99 % quantile and ``max_stretch``, and between the worst stretch, of
        triangles without an angle below 1°, and 3.

    See Also
    --------
    UnwrapResult : Lists them as ``misses``.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> result = unwrap(*starfish(3, 4), max_stretch=1.001, max_charts=1)
    >>> len(result.misses) > 0, bool(result.misses[0].excess > 0)
    (True, True)
    """

    chart: int
    stretch: Stretch
    excess: float


class UnwrapStep(NamedTuple):
    """Progress of `unwrap`, passed to its callback.

    Attributes
    ----------
    phase : str
        First ``"clean"``, then phases of the search for charts, such as ``"cut"``, ``"flatten"`` and ``"improve"``,
        which can repeat, then ``"pack"`` and ``"certify"``.
    done, total : int
        Finished parts of the phase, and all parts.

    See Also
    --------
    unwrap : Passes it to its callback.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> phases = []
    >>> result = unwrap(*starfish(3, 4), callback=lambda step: phases.append(step.phase))
    >>> phases[0], phases[-1]
    ('clean', 'certify')
    """

    phase: str
    done: int
    total: int


@dataclass(frozen=True, eq=False, repr=False)
class UnwrapResult(Outcome, Displayable):
    """Texture coordinates of a model, made by `unwrap`; iterates as ``vmapping, indices, uvs``.

    Attributes
    ----------
    vmapping : (m,) int64
        Vertex of the model for each row of ``uvs``.
    indices : (f, 3) int64
        Rows of ``uvs`` for each triangle of the model, in its order: ``V[vmapping][indices]`` equals ``V[F]``.
    uvs : (m, 2) float64
        Texture coordinates in the unit square, or in the squares of several tiles. They are multiples of a power of
        two that single precision stores exactly, also with v reversed as in glTF.
    charts : (f,) int64
        Chart of each triangle, from 0. With ``faces``, new charts come first.
    seams : (s, 2) int64
        Edges of the model along which the map is cut, by vertices, smaller vertex first, ascending. Of several edges
        whose vertices were merged, the first one is listed.
    certificate : UnwrapCertificate
        The exact verdict on ``uvs``.
    triangle_stretch : (f,) float64
        Stretch of each triangle; NaN for triangles without area and for kept ones.
    stretch : Stretch
        Of the new charts: median, 99 % and worst stretch.
    misses : tuple of Miss
        Charts that exceed the bound on the stretch, largest excess first; empty if it is kept.
    utilisation : float
        Area of all charts divided by the area of the texture.
    cleaned : CleanedMesh
        The cleaned mesh, and what was cleaned.
    status : UnwrapStatus
    resolution : (int, int)
        Width and height of the texture in texels.
    texels_per_unit : float
        Texels per unit of length of the model, in new charts; infinite if double precision has no such number, for
        models smaller than about 1e-305.
    kept_charts : (c,) bool
        Charts whose texture coordinates were kept; see ``faces``.
    V : (n, 2) or (n, 3) float64
        Positions of the model's vertices.
    strips : tuple of Strip
        Strips of quadrilaterals that were found with ``straighten=True``, ordered by first triangle; which of them are
        rectangles now, and how much that stretches them.
    symmetry : Symmetry
        Which plane of symmetry was found, and whether seams and charts are mirrored.
    seconds : float
        Wall time of the call.
    unfinished : (k,) int64
        After a time limit, the charts that were grown by normals, because the search had no bijective charts within the
        bound there; they are more than necessary. Empty if the limit did not end the search.
    source : object
        The mesh of trimesh that was given; None for other meshes.

    See Also
    --------
    unwrap : Makes it.
    bake : Bakes textures for it.
    results.UnwrapStatus : What each status means.

    Examples
    --------
    >>> from quasiharmonic import unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> result = unwrap(*starfish(3, 12))
    >>> result.status.name, len(result.misses), bool(result.stretch.p99 <= 1.5)
    ('UNWRAPPED', 0, True)
    """

    vmapping: IntArray
    indices: IntArray
    uvs: FloatArray
    charts: IntArray
    seams: IntArray
    certificate: UnwrapCertificate
    triangle_stretch: FloatArray
    stretch: Stretch
    misses: tuple[Miss, ...]
    utilisation: float
    cleaned: CleanedMesh
    status: UnwrapStatus
    resolution: tuple[int, int]
    texels_per_unit: float
    kept_charts: BoolArray
    V: FloatArray
    strips: tuple[Strip, ...]
    symmetry: Symmetry
    seconds: float
    unfinished: IntArray
    source: Any = None

    def __iter__(self) -> Iterator[Any]:
        return iter((self.vmapping, self.indices, self.uvs))

    @property
    def success(self) -> bool:
        """Whether every new chart is bijective and overlaps no other chart.

        Charts may still exceed the bound (`misses`). Faults of kept charts count only in ``certificate.bijective``.
        """
        sound = bool(self.certificate.bijective_charts[~self.kept_charts].all())
        return sound and bool(self.kept_charts[self.certificate.overlapping].all())

    @property
    def n_charts(self) -> int:
        """Number of charts."""
        return len(self.certificate.bijective_charts)

    @property
    def seam_length(self) -> float:
        """Total length of the seams, each counted once, in the unit of the model."""
        # In this unit, squares neither overflow nor underflow.
        exponent = find_exponent(self.V)
        ends = np.ldexp(self.V[self.seams], -exponent)
        with np.errstate(over="ignore"):
            return float(np.ldexp(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum(), exponent))

    def inverse(self) -> ChartInverse:
        """Return the inverse map, from the texture to the model, for points, triangles and values of the model.

        Repeated and degenerate triangles have no points of their own. Where stacked charts overlap, the triangle with
        the smallest index counts.
        """
        return ChartInverse(
            self.V, self.vmapping[self.indices], self.uvs, self.indices, leave_out=self.cleaned.excluded
        )

    def to_trimesh(self) -> Trimesh:
        """Return the model as a trimesh.Trimesh with texture coordinates; vertices are split at seams.

        If a mesh of trimesh was unwrapped, colours and attributes of its vertices, attributes of its faces, its
        material and its metadata are kept.
        """
        return make_trimesh(self.V[self.vmapping], self.indices, self.uvs, like=self.source, rows=self.vmapping)

    def plot(self) -> Figure:
        """Draw the charts, and the model with a checkerboard, the stretch and the texel density.

        Returns
        -------
        matplotlib Figure
            Triangles whose orientation differs from that of their chart are red.
        """
        return self._draw("unwrap")

    def short_repr(self) -> str:
        """Return the outcome in a sentence."""
        return self.message

    def summary(self) -> str:
        """Return charts, seams, stretch and utilisation in a few lines."""
        stretch = self.stretch
        lines = [
            f"{count_of('chart', 'charts', self.n_charts)}, {count_of('seam edge', 'seam edges', len(self.seams))} of "
            f"length {self.seam_length:.4g}",
            f"stretch {stretch.median:.3f} in the median, {stretch.p99:.3f} at 99 % of the surface, "
            f"{stretch.worst:.3g} at most"
            if not np.isnan(stretch.worst)
            else "stretch not measured, because all triangles are too thin",
            f"{100 * self.utilisation:.1f} % of the texture used, {self.texels_per_unit:.4g} texels per unit",
            f"certificate: {self.certificate.summary()}",
        ]
        if kept := int(self.kept_charts.sum()):
            lines.append(f"{count_of('chart', 'charts', kept)} kept, {self.n_charts - kept} new")
        lines += describe_symmetry(self.symmetry)
        if self.strips:
            lines.append(_describe_strips(self.strips))
        if self.status is UnwrapStatus.TIME_LIMIT:
            lines.append(
                f"ended by the time limit: {count_of('chart', 'charts', len(self.unfinished))} of {self.n_charts} "
                "grown by normals, because the search had no better ones"
            )
        if self.misses:
            shown = ", ".join(f"chart {miss.chart} by {miss.excess:.3g}" for miss in self.misses[:_LISTED])
            more = f", … ({len(self.misses)} charts)" if len(self.misses) > _LISTED else ""
            lines.append(f"beyond the bound on the stretch: {shown}{more}")
        if (collapsed := self.cleaned.collapsed).size:
            where = names_of("triangle", "triangles", collapsed)
            lines.append(f"collapsed by welding, with texture coordinates of a neighbour: {where}")
        if self.cleaned.close.size:
            lines.append(describe_soup(self.cleaned.close))
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON, without the arrays."""
        return {
            **super().to_dict(),
            "charts": self.n_charts,
            "kept_charts": int(self.kept_charts.sum()),
            "seam_edges": len(self.seams),
            "seam_length": replace_nonfinite(self.seam_length),
            "stretch": _finite(self.stretch),
            "misses": [miss._asdict() | {"stretch": _finite(miss.stretch)} for miss in self.misses],
            **as_plain(self, "utilisation"),
            "texels_per_unit": replace_nonfinite(self.texels_per_unit),
            "resolution": list(self.resolution),
            "strips": [strip._asdict() for strip in self.strips],
            "symmetry": self.symmetry._asdict(),
            "unfinished": self.unfinished.tolist(),
            "reversed": int(self.cleaned.flipped.sum()),
            **as_plain(self.cleaned, "excluded", "collapsed"),
            "close_vertices": self.cleaned.close.tolist(),
            "mesh": self.cleaned.report.to_dict(),
        }


def _describe_strips(strips: tuple[Strip, ...]) -> str:
    """Return a line on what was straightened."""
    left = [f"triangle {strip.triangle} (stretch {strip.stretch:.3g})" for strip in strips if not strip.straightened]
    line = f"{len(strips) - len(left)} of {count_of('strip', 'strips', len(strips))} straightened"
    if left:
        more = ", …" if len(left) > _LISTED else ""
        line += f"; others stay as they are: {', '.join(left[:_LISTED])}{more}"
    return line


def _finite(stretch: Stretch) -> dict[str, float | None]:
    """Return a stretch for JSON, which has neither infinity nor NaN."""
    return {key: replace_nonfinite(value) for key, value in stretch._asdict().items()}
