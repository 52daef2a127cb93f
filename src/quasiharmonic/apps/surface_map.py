"""Maps between surfaces through the plane.

If φ and ψ are bijective maps of two surfaces onto the same region, ψ⁻¹∘φ maps one surface to the other. A composition
of injective maps is injective, and both maps are certified exactly. The map transfers data between unrelated meshes.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.inverse_map import InverseMap, Per, SurfacePoints
from quasiharmonic.geometry.exact.predicates import orientation
from quasiharmonic.util.arrays import FloatArray, check_choice, check_instance

#: The value of vertices without a corresponding point.
Outside = Literal["nan", "nearest"]


class SurfaceMap:
    """The map ψ⁻¹∘φ between two surfaces with maps φ and ψ into the plane.

    Parameters
    ----------
    source, target : InverseMap
        The surfaces with φ and ψ. Both maps must be bijective.

    Raises
    ------
    ValueError
        If one of the maps is not bijective.

    Attributes
    ----------
    source, target : InverseMap
    onto : bool
        Whether both images are exactly the same region. Then every point of either surface has a corresponding point.
        Otherwise only points in the intersection of the images have one. Images with straight sides along the axes,
        such as the unit square, can be the same. With other outlines, rounding and different boundary vertices leave
        a margin.

    See Also
    --------
    InverseMap : Each of the two maps.

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
            check_instance(which, one, InverseMap)
            if not one.certificate.bijective:
                raise ValueError(f"the map of the {which} is not bijective: {one.certificate.summary()}")
        self.source, self.target = source, target
        self.onto = _outline(source) == _outline(target)

    def __call__(self, at: SurfacePoints) -> SurfacePoints:
        """Map points of the source to points of the target.

        Parameters
        ----------
        at : SurfacePoints
            Points of the source.

        Returns
        -------
        SurfacePoints
            Points of the target; triangle -1 where there is no corresponding point.
        """
        return self.target.locate(self.source.plane(at))

    def inverse(self) -> SurfaceMap:
        """Return the map φ⁻¹∘ψ from the target to the source."""
        return SurfaceMap(self.target, self.source)

    def transfer(
        self, values: ArrayLike, *, per: Per = "vertex", outside: Outside = "nan", nearest: bool = False
    ) -> FloatArray:
        """Transfer values from the target to the vertices of the source.

        Parameters
        ----------
        values : array
            Values on the target; see `InverseMap.values`.
        per : {"vertex", "corner", "triangle"}
        outside : {"nan", "nearest"}
            The value of vertices without a corresponding point: NaN, or the value at the nearest point of the target's
            image in the plane. Rounding and different boundary vertices can leave such vertices at the boundary.
            Vertices without a finite position always get NaN.
        nearest : bool
            For labels: instead of interpolating, take the value of the nearest corner of the triangle; see
            `InverseMap.values`.

        Returns
        -------
        (n, ...) float64
            The target's value at the corresponding point of every vertex of the source.

        Raises
        ------
        ValueError
            If the shape of the values does not match, or an option is unknown.
        """
        check_choice("outside", outside, get_args(Outside))
        at = self.target.locate(self.source.uv)
        if outside == "nearest":
            at = self.target.nearest(self.source.uv, at)
        return self.target.values(at, values, per=per, nearest=nearest)


def _outline(mapped: InverseMap) -> set[tuple[tuple[float, float], ...]]:
    """The corners of the image's boundary loops; equal for two maps if and only if the image regions are equal.

    Simple, disjoint loops turn at a vertex exactly if it is a corner of the region.
    """
    outline = set()
    for loop in mapped.certificate.loops:
        here = mapped.uv[loop]
        turns = orientation(np.roll(here, 1, axis=0), here, np.roll(here, -1, axis=0)) != 0
        # Remove the sign of zero, and start each loop at its smallest corner.
        corners = [(x + 0.0, y + 0.0) for x, y in here[turns].tolist()]
        first = corners.index(min(corners))
        outline.add((*corners[first:], *corners[:first]))
    return outline
