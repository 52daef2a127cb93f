"""Advice of the package in terms of Blender: its messages name functions of Python and options of `qhm`."""

from __future__ import annotations

from quasiharmonic.results import Kind

# Parts of the package's messages, and what replaces each.
ADVICE = {
    "remove them with clean, or use unwrap, which excludes them": (
        "remove them with Mesh > Clean Up > Degenerate Dissolve, or use Unwrap Model, which accepts them"
    ),
    "choose the reference 'equilateral', or remove them with clean": (
        "remove them with Mesh > Clean Up > Degenerate Dissolve"
    ),
    "orient all triangles alike with clean": "orient all faces alike with Mesh > Normals > Recalculate Outside",
    "cut it open with clean": "mark such edges as seams and use Flatten",
    "or use unwrap, which does so": "or use Unwrap Model, which accepts this",
    "emove such triangles with clean": "emove such faces with Mesh > Clean Up > Degenerate Dissolve",
    "remove repetitions with clean": "delete one of the two faces in each place",
    "inspect_mesh (qhm check) lists defects, and vertices at equal positions that may need to be merged": (
        "Select > All by Trait > Non Manifold shows defects, and Mesh > Clean Up > Merge by Distance merges vertices"
    ),
    "cut it open first (cut_open; --cut of qhm map and qhm flatten)": "mark seams, or use Cut and Flatten",
    "refine the boundary, or let fewer bends count as corners (corner_angle; qhm map --corner-angle)": (
        "subdivide the mesh at its boundary, or choose another outline"
    ),
    "repair it first (repair; qhm repair)": "use Repair UVs first",
    "make it injective first (quasiharmonic.repair, qhm repair)": "use Repair UVs first",
    "refine_problem, or for surface files qhm refine": "subdivide the mesh there",
    Kind.REVERSED.value: "The border of the island is mirrored: use UV > Mirror first.",
}


def translate_advice(text: str) -> str:
    """Return a message of the package with Blender's operators in place of functions and options."""
    for said, meant in ADVICE.items():
        text = text.replace(said, meant)
    return text
