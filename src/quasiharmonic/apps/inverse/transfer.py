"""From one surface to another by way of the plane.

Two surfaces with bijective maps φ and ψ onto the same region are mapped to each other by ψ⁻¹∘φ. As a composition of
injective maps it is injective, and both verdicts are exact. Data can be carried over with it, between meshes that
have nothing in common.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.inverse.inverse import InverseMap, Per, SurfacePoints
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.util.arrays import FloatArray, check_choice

#: What becomes of vertices without a partner.
Outside = Literal["nan", "nearest"]


class SurfaceMap:
    """The map ψ⁻¹∘φ of one surface to another, through their maps φ and ψ into the plane.

    Parameters
    ----------
    source, target : InverseMap
        The surfaces with φ and ψ; both maps bijective.

    Raises
    ------
    ValueError
        When one of the maps is not bijective.

    Attributes
    ----------
    source, target : InverseMap
    onto : bool
        Whether the two maps' images are the same region, exactly: then every point of either surface has its
        partner. Otherwise those have whose places are in both images. So it is for outlines with straight sides
        along the axes, such as the unit square; along others, rounding and different boundary vertices leave a
        margin.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import InverseMap
    >>> from quasiharmonic.surfaces import grid
    >>> coarse, fine = (InverseMap(uv, F, uv) for uv, F in (grid(3, 3), grid(8, 8)))
    >>> partners = SurfaceMap(coarse, fine)
    >>> partners.onto
    True
    >>> heights = partners.transfer(fine.V.sum(axis=1))
    >>> bool(np.allclose(heights, coarse.V.sum(axis=1)))
    True
    """

    def __init__(self, source: InverseMap, target: InverseMap) -> None:
        for which, one in (("source", source), ("target", target)):
            if not one.certificate.bijective:
                raise ValueError(f"the map of the {which} is not bijective: {one.certificate.summary()}")
        self.source, self.target = source, target
        self.onto = _outline(source) == _outline(target)

    def __call__(self, at: SurfacePoints) -> SurfacePoints:
        """The target's points for points of the source.

        Parameters
        ----------
        at : SurfacePoints
            Points of the source.

        Returns
        -------
        SurfacePoints
            Points of the target; none where the source's point has no partner.
        """
        return self.target.locate(self.source.plane(at))

    def inverse(self) -> SurfaceMap:
        """The map φ⁻¹∘ψ from the target to the source."""
        return SurfaceMap(self.target, self.source)

    def transfer(self, values: ArrayLike, *, per: Per = "vertex", outside: Outside = "nan") -> FloatArray:
        """Bring values from the target to the vertices of the source.

        Parameters
        ----------
        values : array
            Values on the target; see `InverseMap.values`.
        per : {"vertex", "corner", "triangle"}
        outside : {"nan", "nearest"}
            What vertices without a partner get, as rounding and other boundary vertices leave some at the rim: NaN, or
            the value at the point of the target's image that is nearest in the plane. Vertices of no triangle, whose
            places are not finite, have none.

        Returns
        -------
        (n, ...) float64
            The target's value at the partner of each of the source's vertices.

        Raises
        ------
        ValueError
            When the shape of the values does not fit, or an option has no such value.
        """
        check_choice("outside", outside, get_args(Outside))
        at = self.target.locate(self.source.uv)
        if outside == "nearest":
            at = self.target.nearest(self.source.uv, at)
        return self.target.values(at, values, per=per)


def _outline(mapped: InverseMap) -> set[tuple[tuple[float, float], ...]]:
    """The corners of the image's boundary: equal for equal regions, and for no others.

    Loops that are simple and disjoint turn at a vertex exactly if it is a corner of the region.
    """
    outline = set()
    for loop in mapped.certificate.loops:
        here = mapped.uv[loop]
        turns = orientation(np.roll(here, 1, axis=0), here, np.roll(here, -1, axis=0)) != 0
        # Without the sign of zero, and from the least corner on.
        corners = [(x + 0.0, y + 0.0) for x, y in here[turns].tolist()]
        first = corners.index(min(corners))
        outline.add((*corners[first:], *corners[:first]))
    return outline
