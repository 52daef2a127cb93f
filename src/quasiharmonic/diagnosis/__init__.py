"""Why a problem has no map: necessary conditions, each violated one with its elements."""

from quasiharmonic.diagnosis.examine import diagnose
from quasiharmonic.diagnosis.obstruction import Diagnosis, Forbids, Kind, Obstruction

__all__ = ["Diagnosis", "Forbids", "Kind", "Obstruction", "diagnose"]
