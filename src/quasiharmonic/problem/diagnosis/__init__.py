"""Diagnose why a problem has no map: necessary conditions, and the elements that violate each.

The package builds on `problem` and `geometry.exact`. Start reading in `examine`. Each other module has conditions of
one kind, or a tool for them.
"""

from quasiharmonic.problem.diagnosis.examine import diagnose
from quasiharmonic.problem.diagnosis.obstruction import Diagnosis, Forbids, Kind, Obstruction

__all__ = ["Diagnosis", "Forbids", "Kind", "Obstruction", "diagnose"]
