"""Classes that functions return: results, certificates, statuses, and parts of them.

Every result has ``success``, ``status``, ``message``, ``n_iterations``, ``seconds``, ``certificate``, ``summary()`` and
``to_dict()``; every certificate has ``valid``, ``bijective``, ``summary()`` and ``to_dict()``.
"""

from quasiharmonic.apps.air_mesh import AirMeshState
from quasiharmonic.apps.atlas.atlas_verdict import AtlasVerdict
from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas
from quasiharmonic.apps.atlas.packing.pack import Packing
from quasiharmonic.apps.atlas.seam_cuts import CutMesh
from quasiharmonic.apps.baking import BakeResult
from quasiharmonic.apps.displacement_fields.field_inversion import InverseField, InverseVolume
from quasiharmonic.apps.displacement_fields.nearest import InvertibleField
from quasiharmonic.apps.displacement_fields.nearest_voxels import InvertibleVolume, VoxelVerdict
from quasiharmonic.apps.gradients.derivative import Derivative
from quasiharmonic.apps.image_warp import WarpResult
from quasiharmonic.apps.inverse_map import ChartInverse, SurfacePoints
from quasiharmonic.apps.mesh_motion.animation import Animation, AnimationVerdict, FrameStep
from quasiharmonic.apps.mesh_motion.morph_result import MorphResult
from quasiharmonic.apps.tetrahedra.certificate import TetrahedraCertificate
from quasiharmonic.apps.tetrahedra.result import TetrahedraResult, TetrahedraStatus
from quasiharmonic.apps.unwrapping.chart_verdict import UnwrapCertificate
from quasiharmonic.apps.unwrapping.cleaning import CleanedMesh
from quasiharmonic.apps.unwrapping.result import Miss, Stretch, UnwrapResult, UnwrapStatus, UnwrapStep
from quasiharmonic.apps.unwrapping.scenes import ScenePart, SceneResult
from quasiharmonic.apps.unwrapping.straightening import Strip
from quasiharmonic.apps.uv_repair import RepairedIsland, RepairResult
from quasiharmonic.energies.distances import DistanceError
from quasiharmonic.energies.measures import Distortion, Statistics
from quasiharmonic.geometry.exact.certificate import Certificate
from quasiharmonic.geometry.mesh.splitting import Refined
from quasiharmonic.problem.diagnosis import Diagnosis, Forbids, Kind, Obstruction
from quasiharmonic.problem.inspection import MeshReport
from quasiharmonic.problem.result import MapResult, RefinementAttempt, Snapshot, Stage, Status, Step
from quasiharmonic.solver.refinement import RefinedProblem

__all__ = [
    "AirMeshState",
    "Animation",
    "AnimationVerdict",
    "AtlasVerdict",
    "BakeResult",
    "Certificate",
    "ChartInverse",
    "CleanedMesh",
    "CutMesh",
    "Derivative",
    "Diagnosis",
    "DistanceError",
    "Distortion",
    "Forbids",
    "FrameStep",
    "InverseField",
    "InverseVolume",
    "InvertibleField",
    "InvertibleVolume",
    "Kind",
    "MapResult",
    "MappedAtlas",
    "MeshReport",
    "Miss",
    "MorphResult",
    "Obstruction",
    "Packing",
    "Refined",
    "RefinedProblem",
    "RefinementAttempt",
    "RepairResult",
    "RepairedIsland",
    "ScenePart",
    "SceneResult",
    "Snapshot",
    "Stage",
    "Statistics",
    "Status",
    "Step",
    "Stretch",
    "Strip",
    "SurfacePoints",
    "TetrahedraCertificate",
    "TetrahedraResult",
    "TetrahedraStatus",
    "UnwrapCertificate",
    "UnwrapResult",
    "UnwrapStatus",
    "UnwrapStep",
    "VoxelVerdict",
    "WarpResult",
]
