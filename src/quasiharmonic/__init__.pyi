# The public names. `__init__.py` imports each when it is first used.

from . import (
    atlas as atlas,
)
from . import (
    batch as batch,
)
from . import (
    io as io,
)
from . import (
    linsolve as linsolve,
)
from . import (
    plot as plot,
)
from . import (
    results as results,
)
from . import (
    surfaces as surfaces,
)
from . import (
    targets as targets,
)
from .apps.air_mesh import AirMesh as AirMesh
from .apps.atlas.seam_cuts import cut_open as cut_open
from .apps.baking import BakeResult as BakeResult
from .apps.baking import bake as bake
from .apps.displacement_fields.field_inversion import InverseField as InverseField
from .apps.displacement_fields.field_inversion import inverse_field as inverse_field
from .apps.displacement_fields.nearest import (
    InvertibleField as InvertibleField,
)
from .apps.displacement_fields.nearest import (
    nearest_invertible as nearest_invertible,
)
from .apps.flattening.distance_descent import keep_distances as keep_distances
from .apps.flattening.free_boundary import flatten as flatten
from .apps.flattening.patterns import write_pattern as write_pattern
from .apps.gradients.derivative import Derivative as Derivative
from .apps.gradients.map_derivatives import flatten_derivative as flatten_derivative
from .apps.gradients.map_derivatives import polish_derivative as polish_derivative
from .apps.gradients.map_derivatives import quasi_harmonic_derivative as quasi_harmonic_derivative
from .apps.image_warp import (
    WarpResult as WarpResult,
)
from .apps.image_warp import (
    warp_along as warp_along,
)
from .apps.image_warp import (
    warp_by_landmarks as warp_by_landmarks,
)
from .apps.inverse_map import InverseMap as InverseMap
from .apps.mesh_motion.animation import Animation as Animation
from .apps.mesh_motion.frame_sequence import animate as animate
from .apps.mesh_motion.morph_result import MorphResult as MorphResult
from .apps.mesh_motion.morphing import morph as morph
from .apps.mesh_motion.moving_mesh import MovingMesh as MovingMesh
from .apps.surface_map import SurfaceMap as SurfaceMap
from .apps.tetrahedra.certificate import TetrahedraCertificate as TetrahedraCertificate
from .apps.tetrahedra.certificate import certify_tetrahedra as certify_tetrahedra
from .apps.tetrahedra.result import TetrahedraResult as TetrahedraResult
from .apps.tetrahedra.tetrahedral_maps import injective_tetrahedra as injective_tetrahedra
from .apps.unwrapping.cleaning import clean as clean
from .apps.unwrapping.result import UnwrapResult as UnwrapResult
from .apps.unwrapping.unwrap import unwrap as unwrap
from .apps.uv_repair import RepairResult as RepairResult
from .apps.uv_repair import repair as repair
from .energies.energies import Energy as Energy
from .energies.measures import Distortion as Distortion
from .energies.measures import distortion as distortion
from .energies.polishing import polish as polish
from .geometry.curves import BoundaryCurves as BoundaryCurves
from .geometry.exact.certificate import Certificate as Certificate
from .problem import Problem as Problem
from .problem.certification import certify as certify
from .problem.certification import inverted_triangles as inverted_triangles
from .problem.certification import is_injective as is_injective
from .problem.diagnosis import Diagnosis as Diagnosis
from .problem.diagnosis import diagnose as diagnose
from .problem.inspection import MeshReport as MeshReport
from .problem.inspection import boundary_loops as boundary_loops
from .problem.inspection import inspect_mesh as inspect_mesh
from .problem.result import MapResult as MapResult
from .problem.result import Status as Status
from .solver.mapping import injective_map as injective_map
from .solver.mapping import quasi_harmonic_map as quasi_harmonic_map
from .solver.mapping import solve as solve
from .solver.methods import Descent as Descent
from .solver.refinement import refine as refine
from .solver.refinement import refine_problem as refine_problem
from .solver.search.harmonising import harmonise as harmonise
from .solver.search.many import injective_maps as injective_maps
from .targets.cuts.find import crease_costs as crease_costs
from .targets.cuts.find import find_cuts as find_cuts

__version__: str
