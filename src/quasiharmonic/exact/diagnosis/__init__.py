"""Why a problem has no map: necessary conditions, each violated one with its elements."""

from quasiharmonic.exact.diagnosis.examine import diagnose
from quasiharmonic.exact.diagnosis.obstruction import Diagnosis, Forbids, Kind, Obstruction

__all__ = ["Diagnosis", "Forbids", "Kind", "Obstruction", "diagnose"]
