"""Commands and Python scripts that reproduce a map of the page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass

from quasiharmonic.energies.polishing import LARGEST_SMOOTHED, SMOOTHING_STEPS
from quasiharmonic.ui.studio.session.outlines import Outline
from quasiharmonic.ui.studio.session.surface import Sheet

#: Name of the file that the page saves.
MAP = "map.obj"
#: Name of the file with the fixed vertices that the page saves.
FIXED = "fixed.txt"


@dataclass(frozen=True, eq=False)
class Recipe:
    """Description of how a map was computed."""

    sheet: Sheet
    # The outline of the boundary. None if the boundary was moved since, comes from the file, or is free.
    outline: Outline | None = None
    corners: str | None = None  # As for ``--corners`` of the command
    pinned: bool = False  # Whether there are pins
    free: bool = False  # Whether the boundary was free
    energy: str | None = None  # The energy that was lowered until it converged
    slide: bool = False  # Whether the boundary slid during that
    anew: bool = True  # Whether the map was solved from scratch

    def files(self) -> list[str]:
        """Return the names of the files that command and script need besides the surface's file, in saving order."""
        if self.outline is None and not (self.free and not self.pinned):
            return [MAP, FIXED] if self.pinned else [MAP]
        return [self.outline.to] if self.outline is not None and self.outline.content is not None else []

    def command(self) -> str:
        """Return the command line."""
        words = ["qhm"]
        if self.free:
            words += ["flatten", MAP if self.pinned else self.sheet.name]
            words += self._fixed() if self.pinned else list(self.sheet.flags)
            return shlex.join([*words, "-o", "flat.obj"])
        if self.outline is not None:
            words += ["map", self.sheet.name, *self.sheet.flags, "--to", self.outline.to]
            words += [] if self.corners is None else ["--corners", self.corners]
        elif self.anew:
            words += ["map", MAP, *self._fixed()]
        else:
            return shlex.join(["qhm", "polish", MAP, *self._fixed(), "--energy", "blend", "-o", "again.obj"])
        words += [] if self.energy is None else ["--polish", self.energy]
        words += ["--slide"] if self.slide else []
        return shlex.join([*words, "-o", "again.obj"])

    def _fixed(self) -> list[str]:
        return ["--fixed", FIXED] if self.pinned else []

    def python(self) -> str:
        """Return a script that computes ``result``."""
        names, lines = {"io"}, []
        if self.outline is not None and not self.sheet.flags and self.sheet.seamed.seamless:
            lines += [
                f"mesh = io.read_mesh({self.sheet.name!r})",
                "V, F = mesh.V, mesh.F",
                f"contours = {self._contours()}",
                f"fixed, target = boundary_to(V, F, contours{self._corners()})",
            ]
        elif self.free and not self.pinned:
            lines += [f"mesh = io.read_mesh({self.sheet.name!r})", "V, F = mesh.V, mesh.F"]
        else:
            lines += [f"mesh = io.read_mesh({MAP!r})", "V, F, uv = io.cut_at_seams(mesh)"]
            lines += [
                f"fixed = io.read_handles({FIXED!r}, len(V))"
                if self.pinned
                else "fixed = np.unique(np.concatenate(boundary_loops(F, len(V))))"
            ]
            lines += ["target = uv[fixed]"]
        solved, more = self._solve_lines()
        names |= more
        text = "\n".join([*lines, *solved])
        head = ["import numpy as np", ""] if "np." in text else []
        head += [f"from quasiharmonic import {', '.join(sorted(names))}"]
        if "boundary_loops" in text:
            head += ["from quasiharmonic.geometry.mesh.topology import boundary_loops"]
        if "boundary_to" in text:
            used = [name for name in ("boundary_to", "filled", "outline") if f"{name}(" in text]
            head += [f"from quasiharmonic.targets import {', '.join(used)}"]
        if "BoundaryCurves(" in text:
            head += ["from quasiharmonic.targets import outline_curves"]
        return "\n".join([*head, "", text, "print(result.certificate.summary())", ""])

    def _contours(self) -> str:
        assert self.outline is not None
        text = f"outline({self.outline.to!r})"
        # The surface has no holes, so those of the outline are filled.
        return f"filled({text})" if len(self.outline.contours) > 1 and not self._holes() else text

    def _holes(self) -> bool:
        from quasiharmonic.geometry.mesh.topology import boundary_loops

        island = self.sheet.island
        return len(boundary_loops(island.F, len(island.V))) > 1

    def _corners(self) -> str:
        if self.corners is None:
            return ""
        if self.corners == "auto":
            return ', corners="auto"'
        return f", corners={{{', '.join(part.replace(':', ': ') for part in self.corners.split(','))}}}"

    def _solve_lines(self) -> tuple[list[str], set[str]]:
        """Return the lines that solve, and the public names that they use."""
        if self.free:
            held = ", fixed=inside, target=uv[inside]" if self.pinned else ""
            pins = ["edge = np.concatenate(boundary_loops(F, len(V)))", "inside = np.setdiff1d(fixed, edge)"]
            return [*(pins if self.pinned else []), f"result = flatten(V, F{held})"], {"flatten"}
        options = "" if self.energy is None else f", polish={self.energy!r}"
        if self.slide and self.outline is not None:
            options += f", slide=BoundaryCurves(outline_curves({self.outline.to!r}){self._fixed_corners()})"
        elif self.slide:
            options += ", slide=True"
        start = "" if self.anew else ", start=uv"
        lines = [f"result = injective_map(V, F, fixed, target{options}{start})"]
        names = {"injective_map"} | ({"BoundaryCurves"} if self.slide and self.outline is not None else set())
        if self.energy is None and len(self.sheet.island.F) <= LARGEST_SMOOTHED:
            polished = f'polish(V, F, result.uv, fixed=fixed, energy="blend", max_iterations={SMOOTHING_STEPS})'
            return [*lines, f"result = {polished}"], names | {"polish"}
        return lines, names

    def _fixed_corners(self) -> str:
        if self.corners is None or self.corners == "auto":
            return ""
        return f", fixed=[{', '.join(part.partition(':')[0] for part in self.corners.split(','))}]"
