"""The result of a diagnosis: obstructions, each with its kind, its elements and advice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from quasiharmonic.util.arrays import IntArray, ReadOnly, count_of
from quasiharmonic.util.outcome import Displayable, as_plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from quasiharmonic.problem import Problem


class Forbids(Enum):
    """The largest class of maps that an obstruction excludes; the value is a message.

    See Also
    --------
    results.Obstruction : States what it forbids.

    Examples
    --------
    >>> from quasiharmonic.results import Forbids
    >>> [one.name for one in Forbids]
    ['INJECTIVE', 'UNBRANCHED', 'BIJECTIVE']
    """

    INJECTIVE = "no map without inverted triangles exists"
    UNBRANCHED = "a map without inverted triangles winds more than once around one of its vertices"
    BIJECTIVE = "no bijective map exists, but a map without inverted triangles may"


class Kind(Enum):
    """The kind of an obstruction; the value is advice for the user.

    See Also
    --------
    results.Obstruction : Has a kind.

    Examples
    --------
    >>> from quasiharmonic import boundary_loops, diagnose
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> (obstruction,) = diagnose(V, F, rim, V[rim[::-1]]).obstructions
    >>> obstruction.kind.name
    'REVERSED'
    """

    COLLAPSED_EDGE = "Give the two vertices different positions."
    INVERTED_TRIANGLE = "Split the triangle's interior edges, or move one of its vertices."
    INVERTED_PATCH = "Split the fixed edges around the patch, or move their vertices."
    SIGNED_AREA = "Reflect the target or reverse its loops until it winds counterclockwise around the mesh."
    HALF_PLANES = "Split the edges between the vertex and the edges it should lie to the left of."
    REVERSED = (
        "Check that fixed and target are in the same order, and try target[::-1]. Otherwise reverse the winding of the "
        "triangles, F[:, ::-1], or reflect the target."
    )
    TURNING_NUMBER = "Untwist the target: reverse or move the loops until their turning numbers add up."
    NEGATIVE_WINDING = "Untwist the target, or move the loops so that holes lie inside and run clockwise."
    GENUS = "Cut the handles of the surface open."
    CROSSING = "Move the named boundary edges apart if the map must not overlap itself."
    FOLD = "Open the angle at the named vertices if the map must not overlap itself."
    NESTING = "Move the loops so that one lies outside all others and these outside each other."
    CHORD = "Split the edge so that it can bend, or move its ends."
    PIN = "Move the pin."
    LINK_DISTANCE = "Split the edges on the shortest paths between the two vertices, or move them."
    HIDDEN = "Split the edges between the vertex and the fixed vertices, because no point sees all of them."


# The fields of an obstruction with elements, and the shape of each.
_ELEMENTS = {"vertices": (-1,), "edges": (-1, 2), "triangles": (-1,), "loops": (-1,), "split": (-1, 2)}


def _none() -> IntArray:
    """No elements."""
    return np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Obstruction(ReadOnly):
    """One proven reason why there is no map.

    Attributes
    ----------
    kind : Kind
        The violated condition.
    forbids : Forbids
        Whether it excludes every injective map or only the bijective ones.
    message : str
        A sentence that names the elements.
    vertices : (a,) int64
        Vertices of the mesh. A vertex without valid position comes first.
    edges : (b, 2) int64
        Edges of the mesh, by their vertices.
    triangles : (c,) int64
        Triangles of the mesh.
    loops : (d,) int64
        Boundary loops, as indices into ``Domain.loops``.
    split : (s, 2) int64
        Interior edges whose split would remove the obstruction. Empty if no refinement of the mesh helps.

    See Also
    --------
    Diagnosis : Lists them as ``obstructions``.
    results.Kind : The violated condition.

    Examples
    --------
    >>> from quasiharmonic import boundary_loops, diagnose
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> (obstruction,) = diagnose(V, F, rim, V[rim[::-1]]).obstructions
    >>> obstruction.forbids.name, obstruction.split.tolist()
    ('INJECTIVE', [])
    """

    kind: Kind
    forbids: Forbids
    message: str
    vertices: IntArray = field(default_factory=_none)
    edges: IntArray = field(default_factory=_none)
    triangles: IntArray = field(default_factory=_none)
    loops: IntArray = field(default_factory=_none)
    split: IntArray = field(default_factory=_none)

    def __post_init__(self) -> None:
        for name, shape in _ELEMENTS.items():
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.int64).reshape(shape))
        self._seal()

    def _read_only(self) -> list[IntArray]:
        return [getattr(self, name) for name in _ELEMENTS]

    @property
    def advice(self) -> str:
        """Advice for the user, in one sentence."""
        return self.kind.value

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON: names in lower case, arrays as lists."""
        return {
            "kind": self.kind.name.lower(),
            "forbids": self.forbids.name.lower(),
            **as_plain(self, "message", "advice", *_ELEMENTS),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Diagnosis(Displayable):
    """All obstructions found, and the conditions that were not checked.

    Attributes
    ----------
    obstructions : tuple of Obstruction
        Obstructions of the whole target first, then those of single elements. An empty tuple does not prove that a map
        exists.
    unchecked : tuple of str
        Conditions that do not apply to this problem or were not decided, and why.
    problem : Problem or None
        The examined problem, if there is one.

    See Also
    --------
    diagnose : Makes it.
    results.Obstruction : One reason why there is no map.

    Examples
    --------
    >>> from quasiharmonic import boundary_loops, diagnose
    >>> from quasiharmonic.surfaces import disk
    >>> V, F = disk(4)
    >>> (rim,) = boundary_loops(F)
    >>> diagnose(V, F, rim, V[rim]).obstructions
    ()
    """

    obstructions: tuple[Obstruction, ...]
    unchecked: tuple[str, ...] = ()
    problem: Problem | None = None

    @property
    def forbids_injective(self) -> bool:
        """Whether it is proven that every map of this problem inverts a triangle."""
        return any(o.forbids is Forbids.INJECTIVE for o in self.obstructions)

    @property
    def forbids_bijective(self) -> bool:
        """Whether it is proven that no map of this problem is bijective."""
        return bool(self.obstructions)

    @property
    def split(self) -> IntArray:
        """Edges that the obstructions advise to split, each once; (s, 2) int64, smaller index first."""
        every = [np.sort(o.split, axis=1) for o in self.obstructions]
        return np.unique(np.concatenate([_none().reshape(0, 2), *every]), axis=0)

    def summary(self, most: int = 5) -> str:
        """Return the diagnosis as text.

        Parameters
        ----------
        most : int
            Number of obstructions of one kind to list; further ones are only counted.
        """
        if self.forbids_injective:
            lines = ["No injective map exists: every map with these positions inverts a triangle."]
        elif self.obstructions:
            lines = ["No bijective map exists. A map without inverted triangles may exist."]
        else:
            lines = ["No known obstruction: a map may exist."]
        counts = Counter(o.kind for o in self.obstructions)
        for kind in counts:
            same = [o for o in self.obstructions if o.kind is kind]
            lines += [f"- {o.message} ({o.forbids.value})" for o in same[:most]]
            if len(same) > most:
                lines.append(f"- … and {len(same) - most} more of this kind")
            lines.append(f"  {kind.value}")
        if len(self.split):
            edges = count_of("edge", "edges", len(self.split))
            lines.append(f"Splitting {edges} may help: refine_problem, or for surface files qhm refine.")
        lines += [f"Not checked: {text}" for text in self.unchecked]
        return "\n".join(lines)

    def short_repr(self) -> str:
        if not self.obstructions:
            return "no known obstruction"
        kinds = Counter(o.kind.name.lower().replace("_", " ") for o in self.obstructions)
        found = ", ".join(f"{count} × {kind}" for kind, count in kinds.items())
        return f"no {'injective' if self.forbids_injective else 'bijective'} map: {found}"

    def plot(self) -> Figure:
        """Draw the surface and the target positions of its fixed vertices, with the obstructions in red.

        Returns
        -------
        matplotlib Figure

        Raises
        ------
        ValueError
            If ``problem`` is None.
        """
        return self._draw("diagnosis")

    def to_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON: the forbidden classes, every obstruction, the edges to split."""
        return as_plain(self, "forbids_injective", "forbids_bijective", "obstructions", "split", "unchecked")


def smallest_conflict(count: int, possible: Callable[[list[int]], bool]) -> list[int]:
    """Return a minimal conflict: conditions that cannot all hold, but can without any one of them.

    ``possible`` returns whether the conditions with given indices can hold together; False for all ``count`` of them.
    Return ascending indices. Each costs about ``log2(count)`` calls.
    """
    chosen: list[int] = []
    end = count
    while possible(chosen):
        # Find the first condition that contradicts the chosen ones and those before it.
        low, high = 1, end
        while low < high:
            middle = (low + high) // 2
            if possible([*range(middle), *chosen]):
                low = middle + 1
            else:
                high = middle
        end = high - 1
        chosen.insert(0, end)
    return chosen


def renumber_obstruction(found: Obstruction, vertices: IntArray, triangles: IntArray) -> Obstruction:
    """Return an obstruction of a part in the numbering of the mesh; ``vertices`` and ``triangles`` are the mesh's."""
    return replace(
        found,
        vertices=vertices[found.vertices],
        edges=vertices[found.edges],
        triangles=triangles[found.triangles],
        split=vertices[found.split],
    )
