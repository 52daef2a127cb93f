"""Why a problem has no map: necessary conditions, each violated one with its elements."""

from .examine import diagnose
from .obstruction import Diagnosis, Forbids, Kind, Obstruction

__all__ = ["Diagnosis", "Forbids", "Kind", "Obstruction", "diagnose"]
