"""Classes that functions return as results or as parts of them; programs name them only in annotations."""

from quasiharmonic.apps.air_mesh.airmesh import AirMeshState
from quasiharmonic.apps.animation.frames import FrameStep
from quasiharmonic.apps.atlas.seam_cuts import CutMesh
from quasiharmonic.apps.inverse.inverse_map import SurfacePoints
from quasiharmonic.apps.repair.uv_repair import RepairedIsland
from quasiharmonic.apps.unwrapping.chart_verdict import UnwrapCertificate
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.apps.unwrapping.result import Miss, Stretch, UnwrapStatus, UnwrapStep
from quasiharmonic.energies.distances import DistanceError
from quasiharmonic.energies.measures import Statistics
from quasiharmonic.geometry.mesh.refinement import Refined
from quasiharmonic.problem.diagnosis import Forbids, Kind, Obstruction
from quasiharmonic.problem.result import RefinementAttempt, Snapshot, Stage, Step
from quasiharmonic.solver.refine.refining import RefinedProblem

__all__ = [
    "AirMeshState",
    "CleanedMesh",
    "CutMesh",
    "DistanceError",
    "Forbids",
    "FrameStep",
    "Kind",
    "Miss",
    "Obstruction",
    "Refined",
    "RefinedProblem",
    "RefinementAttempt",
    "RepairedIsland",
    "Snapshot",
    "Stage",
    "Statistics",
    "Step",
    "Stretch",
    "SurfacePoints",
    "UnwrapCertificate",
    "UnwrapStatus",
    "UnwrapStep",
]
