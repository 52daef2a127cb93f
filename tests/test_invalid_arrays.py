"""Indices, loops and frames that are not valid are named in the error."""

from __future__ import annotations

import traceback

import numpy as np
import pytest

from quasiharmonic import (
    AirMesh,
    BoundaryCurves,
    InverseMap,
    Problem,
    certify,
    distortion,
    flatten,
    inverted_triangles,
    io,
    is_injective,
    nearest_invertible,
    polish,
    refine,
    unwrap,
    warp_by_landmarks,
)
from quasiharmonic.apps.mesh_motion.quality import element_quality
from quasiharmonic.atlas import SeamedMesh, pack_charts
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.geometry.mesh.topology import boundary_loops, components
from quasiharmonic.plot import plot_map
from quasiharmonic.results import SurfacePoints
from quasiharmonic.targets import boundary_to, flattened_edges
from quasiharmonic.ui.cli import main
from shared.caller_arrays import LOOPS, RIM, SQUARE, UV, F, N, V

BAD = {
    "one row of two": [[0, 1]],
    "one row of none": [[]],
    "floats": [0.5, 1.0],
    "a mask": np.ones(N, dtype=bool),
    "matrix": np.zeros((2, 2), dtype=int),
    "cube": np.zeros((2, 2, 3), dtype=int),
    "beyond 2^63": np.array([2**63, 1, 2], dtype=np.uint64),
    "integers and floats": [2**53 + 1, 0.5, 1],
    "beyond 2^64": [2**70, 1],
    "negative": [-1, 0, 1],
    "too large": [0, 1, 10**6],
    "None": None,
    "words": ["a", "b"],
    "one word": "abc",
    "a number": 3,
    "a mapping": {"a": 1},
    "objects": np.array([None, 1], dtype=object),
    "rows that differ": [[0, 1], [2]],
    "NaN": [np.nan],
    "complex": [1j],
}


TAKERS = {
    "certify loops": lambda x: certify(F, UV, loops=x),
    "certify one loop": lambda x: certify(F, UV, loops=[x]),
    "certify F": lambda x: certify(x, UV),
    "is_injective": lambda x: is_injective(x, UV),
    "inverted_triangles": lambda x: inverted_triangles(x, UV),
    "Problem F": lambda x: Problem(V, x, RIM, UV[RIM]),
    "Problem fixed": lambda x: Problem(V, F, x, UV[RIM]),
    "polish fixed": lambda x: polish(V, F, UV, fixed=x),
    "refine": lambda x: refine(V, F, x),
    "SeamedMesh F": lambda x: SeamedMesh(V, x),
    "SeamedMesh cut": lambda x: SeamedMesh(V, F).cut(x),
    "distortion": lambda x: distortion(V, x, UV),
    "InverseMap": lambda x: InverseMap(V, x, UV),
    "SurfacePoints": lambda x: InverseMap(V, F, UV).surface(SurfacePoints(x, np.ones((3, 3)) / 3)),
    "boundary_to": lambda x: boundary_to(V, F, "rect:2x1", corners=x),
    "flattened_edges F": lambda x: flattened_edges(x, RIM, UV[RIM]),
    "flattened_edges fixed": lambda x: flattened_edges(F, x, UV[RIM]),
    "AirMesh F": lambda x: AirMesh(UV, x, SQUARE),
    "AirMesh frame": lambda x: AirMesh(UV, F, x),
    "landmarks": lambda x: warp_by_landmarks(np.zeros((9, 9)), x, x),
    "BoundaryCurves.around": lambda x: BoundaryCurves.around(x, UV),
    "BoundaryCurves on": lambda x: BoundaryCurves([UV[RIM]], on=x),
    "pack_charts uv": lambda x: pack_charts([(x, F)]),
    "pack_charts F": lambda x: pack_charts([(UV, x)]),
    "plot_map": lambda x: plot_map(V, x, UV),
    "boundary_loops": lambda x: boundary_loops(x, N),
    "components": lambda x: components(x, N),
    "DeformationEnergy": lambda x: DeformationEnergy(V, x, ARAP()),
    "ReferenceMesh": lambda x: ReferenceMesh(V, x, "rest"),
    "mean_ratio": lambda x: mean_ratio(UV, x),
    "inverted_elements": lambda x: inverted_elements(x, UV),
    "element_quality": lambda x: element_quality(x, UV),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TAKERS)
def test_invalid_indices_are_named(name):
    refused = 0
    for what, value in BAD.items():
        try:
            TAKERS[name](value)
        except ValueError as error:
            refused += 1
            files = [frame.filename for frame in traceback.extract_tb(error.__traceback__)]
            own, message = "quasiharmonic" in files[-1], str(error)
        except Exception as error:
            raise AssertionError(f"{what}: {error!r}") from error
        else:
            continue
        # The library must raise the error, not NumPy.
        assert own, (what, message)
        assert len(message) > 15, what
    assert refused > len(BAD) // 2


@pytest.mark.parametrize(
    ("loops", "said"),
    [
        ([[0, 1]], r"loops\[0\] has 2 vertices, but a boundary loop has three or more"),
        ([RIM, [3]], r"loops\[1\] has 1 vertex, but"),
        ([], "loops has no boundary loop: omit it"),
        ([[]], r"loops\[0\] has 0 vertices"),
        (RIM, r"loops\[0\] must have shape \(l,\), the vertices of one loop, not \(\); pass a list of loops"),
        ([RIM[None]], r"loops\[0\] must have shape \(l,\), the vertices of one loop, not \(1, 12\)$"),
        ([RIM + 0.5], r"loops\[0\] must contain integer indices, not float64"),
        ([RIM > 0], r"loops\[0\] must contain integer indices, not bool"),
        ([RIM, RIM + N], r"loops\[1\] refers to vertices 26, .*, but there are only vertices 0 … 18"),
        (
            [np.array([0, 1, 2**63], dtype=np.uint64)],
            r"loops\[0\] refers to vertex 9223372036854775808, which is not a valid index",
        ),
        (7, "loops must be a sequence of boundary loops, not 7"),
        ("rim", "loops must be a sequence of boundary loops, not 'rim'"),
    ],
)
def test_invalid_loops(loops, said):
    for boundary in (True, False):
        with pytest.raises(ValueError, match=said):
            certify(F, UV, loops=loops, boundary=boundary)


def test_loops_of_any_integer_type():
    for dtype in (np.int8, np.int32, np.uint64, ">i4"):
        assert certify(F, UV, loops=[RIM.astype(dtype)]).bijective
    assert certify(F, UV, loops=np.array(LOOPS)).bijective
    assert certify(F, UV, loops=tuple(loop.tolist() for loop in LOOPS)).bijective
    assert certify(np.empty((0, 3), dtype=int), UV, loops=[]).bijective is False


def test_lists_of_integers_and_floats_are_not_rounded():
    T = [[0, 1, 2]]
    for wide in (2**53 + 1, -(2**53) - 1, np.int64(2**62 + 1)):
        for uv in ([[0, 0.5], [wide, 0], [0, 1]], [np.array([0, 0.5]), (wide, 0), [0.0, 1]]):
            for function in (certify, is_injective, inverted_triangles):
                with pytest.raises(ValueError, match=r"uv does not fit double precision at vertex 1$"):
                    function(T, uv)
    assert is_injective(T, [[0, 0.5], [2**60, 0], [0, 1]])
    assert is_injective(T, [[0, 0.5], [2.0**60, 0], [0, 1]])
    assert certify(T, [[0, 0.5], [np.inf, 2**53], [0, 1]]).nonfinite.tolist() == [0]


@pytest.mark.parametrize("large", [2**63, 2**70, -(2**70)])
def test_integers_beyond_64_bits_are_named(large):
    for loops in ([[large, 1, 2]], [np.array([large, 1, 2], dtype=object)]):
        with pytest.raises(ValueError, match=rf"loops\[0\] refers to vertex {large}, which is not a valid index$"):
            certify(F, UV, loops=loops)


def test_integers_with_thousands_of_digits_are_rejected_in_one_line():
    with pytest.raises(ValueError, match=r"F refers to vertex about 1e5000, which is not a valid index$"):
        certify([[10**5000, 1, 2]], UV)


def test_objects_and_mixed_integers_are_indices():
    wanted = certify(F, UV)
    assert certify(F.astype(object), UV).injective == wanted.injective
    assert certify([[np.uint64(0), np.int64(1), 2]], [[0, 0], [1, 0], [0, 1]]).injective
    for entry in (None, True, 1.0):
        with pytest.raises(ValueError, match="F must contain integer indices, not objects"):
            certify(np.array([[0, 1, entry]], dtype=object), UV)


def test_masked_elements_are_rejected():
    assert certify(np.ma.array(F), np.ma.array(UV)).injective
    for wrong in ((np.ma.masked_equal(F, 3), UV), (F, np.ma.masked_less(UV, 0))):
        with pytest.raises(ValueError, match=r"has masked elements: fill them or leave them out$"):
            certify(*wrong)
    with pytest.raises(ValueError, match="extra has masked elements"):
        io.MeshData(V, F, extra=np.ma.masked_less(V, 0.5))
    chosen = np.ma.array([True] * len(F), mask=[True] + [False] * (len(F) - 1))
    with pytest.raises(ValueError, match="faces has masked elements"):
        unwrap(V, F, uv=UV, faces=chosen)
    with pytest.raises(ValueError, match="fixed has masked elements"):
        nearest_invertible(np.zeros((2, 2, 2)), fixed=np.ma.masked_equal([[True, False], [True, True]], False))
    with pytest.raises(ValueError, match="cells of a dict has masked elements"):
        certify({"points": V, "cells": np.ma.masked_equal([[0, 1, 2, 3]], 3)}, UV)


def test_invalid_frames():
    for frame in (None, 3, "rect:2x1"):
        with pytest.raises(ValueError, match=r"frame must be a list of loops \(k, 2\), .*, not"):
            AirMesh(UV, F, frame)
    with pytest.raises(ValueError, match="loop 0 of the frame must contain real numbers, not None"):
        AirMesh(UV, F, [None])


def test_a_corner_that_is_not_a_vertex():
    for corner in (N, -1, 10**6):
        with pytest.raises(ValueError, match=f"corners refers to vertex {corner}, but there are only vertices 0 … 18"):
            boundary_to(V, F, "rect:2x1", corners=[*RIM[:3], corner])
        with pytest.raises(ValueError, match=f"corners refers to vertex {corner}"):
            boundary_to(V, F, "rect:2x1", corners={corner: (0.0, 0.0)})
    with pytest.raises(ValueError, match="vertex 0 in corners, but not on the boundary"):
        boundary_to(V, F, "rect:2x1", corners=[*RIM[:3], 0])


@pytest.mark.parametrize(
    ("options", "said", "counted"),
    [
        (["--to", "letter:QH"], "character must be a single character", False),
        (["--to", "star:30"], "too few to keep the 60 corners", False),
        (["--to", "rect:1x1", "--corners", "0,1,2,4"], "vertex 4 in corners, but not on the boundary", True),
        (["--to", "rect:1x1", "--corners", "0,1,2,9"], "corners refers to vertex 9, but there are only", False),
        (["--to", "rect:1x1", "--corners", "0,1,2,1"], "vertex 1 is named more than once", False),
    ],
)
def test_messages_state_the_numbering(options, said, counted, tmp_path, capsys):
    mesh = tmp_path / "tent.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0.5 0.5 0\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\n")
    assert main(["map", str(mesh), "-o", str(tmp_path / "out.obj"), *options]) == 2
    complained = capsys.readouterr().err
    assert said in complained
    assert complained.rstrip().endswith("(indices count from 0)") == counted
    assert ("from 0)" in complained) == counted


def test_an_energy_without_a_flattening(tmp_path, capsys):
    assert main(["batch", str(tmp_path), "-o", str(tmp_path / "out"), "--energy", "mips", "--polish", "mips"]) == 2
    assert "energy applies only to flatten" in capsys.readouterr().err


def test_errors_of_arrays_of_other_libraries_are_reported():
    class Broken:
        def __array__(self, dtype=None, copy=None):
            raise ValueError("the file is closed")

    with pytest.raises(ValueError, match=r"V is a Broken .* the file is closed"):
        flatten(Broken(), [[0, 1, 2]])
