"""Arguments of public functions: arrays changed by another thread, arrays that stay unchanged, invalid indices."""

from __future__ import annotations

import copy
import ctypes
import pickle
import subprocess
import sys
import traceback
from importlib import import_module

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
    injective_map,
    inverted_triangles,
    is_injective,
    polish,
    refine,
    warp_by_landmarks,
)
from quasiharmonic.apps.atlas.packing.pack import pack_charts
from quasiharmonic.apps.mesh_motion.quality import element_quality
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP
from quasiharmonic.energies.measures import mean_ratio
from quasiharmonic.geometry.exact.batched_loops import certify_each
from quasiharmonic.geometry.exact.jacobian_signs import inverted_elements
from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.geometry.mesh.operators import operators
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.geometry.mesh.topology import boundary_loops, components
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.plot import plot_map
from quasiharmonic.problem import Domain
from quasiharmonic.results import SurfacePoints
from quasiharmonic.surfaces import disk
from quasiharmonic.targets import boundary_to, flattened_edges
from quasiharmonic.ui.cli import main

V, F = disk(2)
UV = V[:, :2].copy()
N = len(V)
LOOPS = boundary_loops(F, N)
RIM = np.concatenate(LOOPS)
SQUARE = [[(-3, -3), (3, -3), (3, 3), (-3, 3)]]

# While functions work on F, a second thread writes invalid indices into it and removes them again.
REWRITTEN = """
import sys, threading, time
import numpy as np
from quasiharmonic import certify, distortion, flatten, inverted_triangles, injective_map, is_injective
from quasiharmonic import InverseMap, polish
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP
from quasiharmonic.geometry.mesh.reference import ReferenceMesh
from quasiharmonic.geometry.mesh.topology import boundary_loops, components
from quasiharmonic.results import SurfacePoints
from quasiharmonic.surfaces import disk

sys.setswitchinterval(1e-6)
calls, seconds = {calls}, {seconds}
for call, rings in calls.items():
    V, good = disk(rings)
    V = np.ascontiguousarray(V[:, :2])
    rim = np.concatenate(boundary_loops(good, len(V)))
    w = V.view(complex).ravel()
    # With a triangle inverted, `certify` counts turns too.
    folded = V.copy()
    folded[0] = 0.5
    F = good.copy()
    done = False

    def rewrite():
        while not done:
            F[...] = 2**40
            F[...] = good
            time.sleep(0.0001)

    writer = threading.Thread(target=rewrite)
    # If this process dies, the last line names the call.
    print(call, end=" ", flush=True)
    run = compile(call, call, "eval")
    writer.start()
    taken = refused = 0
    begin = time.process_time()
    while time.process_time() - begin < seconds or not taken + refused:
        try:
            eval(run)
            taken += 1
        except ValueError as error:
            assert str(error), error
            refused += 1
    done = True
    writer.join()
    print(taken, refused)
"""
# Each call, and the rings of its disk; fewer for slow functions.
CALLS = {
    "certify(F, V)": 120,
    "certify(F, folded, loops=[rim])": 120,
    "inverted_triangles(F, V)": 120,
    "is_injective(F, V)": 120,
    "boundary_loops(F, len(V))": 120,
    "components(F, len(V))": 120,
    "distortion(V, F, V)": 60,
    "flatten(V, F, max_iterations=1)": 20,
    "injective_map(V, F, rim, V[rim])": 30,
    "polish(V, F, V, fixed=rim, max_iterations=1)": 30,
    "InverseMap(V, F, V).locate(V)": 120,
    "DeformationEnergy(V, F, ARAP()).value(w)": 120,
    "ReferenceMesh(V, F, 'rest').derivatives(w)": 120,
}


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.15, pytest.param(1, marks=pytest.mark.nightly)])
def test_triangles_that_another_thread_overwrites(seconds):
    text = REWRITTEN.format(calls=CALLS, seconds=seconds)
    ran = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, (ran.returncode, ran.stdout.splitlines()[-1:], ran.stderr[-2000:])
    counts = [line.split()[-2:] for line in ran.stdout.splitlines()]
    assert len(counts) == len(CALLS)
    # Some calls met the invalid indices.
    assert sum(int(refused) for _, refused in counts) > 0


# Calls of kernels that require valid indices.
KERNELS = {
    "geometry.exact.triangles": ["sure_signs", "count_turns"],
    "geometry.exact.loops": ["doubtful_pairs"],
    "geometry.mesh.topology": ["sort_edges", "link_nodes", "follow_loops"],
    "geometry.mesh.reference": ["lay_flat", "wirtinger"],
    "energies.deformation": ["jacobians", "pulls", "collapses"],
    "linsolve.pattern": ["find_pattern"],
    "linsolve.laplacian": ["assemble", "boundary_load", "put_at"],
    "geometry.exact.point_location": ["sure_hits"],
    "geometry.exact.nested_grid": ["find_cells", "divide_cells"],
}
# Calls with the arrays V, F, uv and the boundary, all of which must stay unchanged.
FUNCTIONS = {
    "certify": lambda V, F, uv, rim: certify(F, uv),
    "certify, the loops known": lambda V, F, uv, rim: certify(F, uv * [[1.0, -1.0]], loops=[rim]),
    "inverted_triangles": lambda V, F, uv, rim: inverted_triangles(F, uv),
    "is_injective": lambda V, F, uv, rim: is_injective(F, uv),
    "boundary_loops": lambda V, F, uv, rim: boundary_loops(F, len(V)),
    "components": lambda V, F, uv, rim: components(F, len(V)),
    "distortion": lambda V, F, uv, rim: distortion(V, F, uv),
    "flatten": lambda V, F, uv, rim: flatten(V, F, max_iterations=1),
    "injective_map": lambda V, F, uv, rim: injective_map(V, F, rim, uv[rim]),
    "polish": lambda V, F, uv, rim: polish(V, F, uv, fixed=rim, max_iterations=1),
    "InverseMap": lambda V, F, uv, rim: InverseMap(V, F, uv).locate(uv),
    "DeformationEnergy": lambda V, F, uv, rim: DeformationEnergy(V, F, ARAP()).value(uv.view(complex).ravel().copy()),
    "ReferenceMesh": lambda V, F, uv, rim: ReferenceMesh(V.copy(), F, "rest").derivatives(np.zeros(len(V), complex)),
    "operators": lambda V, F, uv, rim: operators(V.copy(), F),
    "Laplacian": lambda V, F, uv, rim: Laplacian(F, len(V), rim),
    "contacts": lambda V, F, uv, rim: contacts(uv.copy(), F[:, :2], 9),
    "SeamedMesh": lambda V, F, uv, rim: SeamedMesh(V, F, F, uv).islands,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_kernels_get_no_arrays_that_the_caller_can_change(name, monkeypatch):
    given = [np.ascontiguousarray(array) for array in (V[:, :2].copy(), F.copy(), UV.copy(), RIM.copy())]
    reports_progress = []

    def listening(kernel, function):
        def listened(*arguments):
            arrays = [array for array in arguments if isinstance(array, np.ndarray)]
            reports_progress.append((kernel, any(np.may_share_memory(array, g) for array in arrays for g in given)))
            return function(*arguments)

        return listened

    for room, kernels in KERNELS.items():
        module = import_module(f"quasiharmonic.{room}")
        for kernel in kernels:
            monkeypatch.setattr(module, kernel, listening(kernel, getattr(module, kernel)))
    FUNCTIONS[name](*given)
    assert reports_progress
    assert [kernel for kernel, shared in reports_progress if shared] == []


def plain(array, folder):
    return array.copy(), lambda kept, now: kept.__setitem__(..., now)


def read_only_view(array, folder):
    base = array.copy()
    view = base.view()
    view.flags.writeable = False
    return view, lambda _, now: base.__setitem__(..., now)


def opened_again(array, folder):
    own = array.copy()
    own.flags.writeable = False

    def change(kept, now):
        kept.flags.writeable = True
        kept[...] = now

    return own, change


def of_a_buffer(array, folder):
    memory = bytearray(array.tobytes())
    view = np.frombuffer(memory, array.dtype).reshape(array.shape)
    view.flags.writeable = False
    return view, lambda _, now: memory.__setitem__(slice(None), np.full(array.shape, now, array.dtype).tobytes())


def of_a_memoryview(array, folder):
    base = array.copy()
    return np.asarray(memoryview(base).toreadonly()), lambda _, now: base.__setitem__(..., now)


def of_a_file(array, folder):
    path = folder / str(len(list(folder.iterdir())))
    array.tofile(path)
    shared = np.memmap(path, array.dtype, "r+", shape=array.shape)
    return np.memmap(path, array.dtype, "r", shape=array.shape), lambda _, now: shared.__setitem__(..., now)


def of_foreign_memory(array, folder):
    memory = (ctypes.c_char * array.nbytes).from_buffer_copy(array.tobytes())
    view = np.frombuffer(memory, array.dtype).reshape(array.shape)
    view.flags.writeable = False
    return view, lambda _, now: ctypes.memmove(memory, np.full(array.shape, now, array.dtype).tobytes(), array.nbytes)


KINDS = (plain, read_only_view, opened_again, of_a_buffer, of_a_memoryview, of_a_file, of_foreign_memory)


def found(result):
    """The arrays of a result that are guaranteed to be valid, by name."""
    if isinstance(result, Problem):
        result = result.domain
    named = {name: array for name, array in vars(result).items() if isinstance(array, np.ndarray)}
    named |= {f"loop {k}": loop for k, loop in enumerate(getattr(result, "loops", ()))}
    if hasattr(result, "certificate"):
        named |= {f"certificate {name}": array for name, array in found(result.certificate).items()}
    if hasattr(result, "domain"):
        named |= {f"domain {name}": array for name, array in found(result.domain).items()}
    return named


RESULTS = {
    "certify": lambda V, F, uv, rim: certify(F, uv, loops=[rim]),
    "certify twice": lambda V, F, uv, rim: certify(certify(F, uv, loops=[rim]).F, uv),
    "Domain": lambda V, F, uv, rim: Domain(V, F, rim),
    "Problem": lambda V, F, uv, rim: Problem(V, F, rim, uv[rim]),
    "distortion": lambda V, F, uv, rim: distortion(V, F, uv),
    "InverseMap": lambda V, F, uv, rim: InverseMap(V, F, uv),
    "SeamedMesh": lambda V, F, uv, rim: SeamedMesh(V, F, F, uv),
    "polish": lambda V, F, uv, rim: polish(V, F, uv, fixed=rim, max_iterations=1),
    "refine": lambda V, F, uv, rim: refine(V, F, [[int(F[0, 0]), int(F[0, 1])]], boundary=True),
    "AirMesh": lambda V, F, uv, rim: AirMesh(uv, F, SQUARE).moment,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", RESULTS)
def test_results_do_not_depend_on_later_changes_by_the_caller(name, kind, tmp_path):
    given = [kind(array, tmp_path) for array in (V, F, UV, RIM)]
    writeable = [array.flags.writeable for array, _ in given]
    result = RESULTS[name](*(array for array, _ in given))
    assert [array.flags.writeable for array, _ in given] == writeable
    before = {label: array.copy() for label, array in found(result).items()}
    assert before
    for (array, change), now in zip(given, (7.0, F[:, ::-1], -UV, 0), strict=True):
        change(array, now)
        np.testing.assert_array_equal(array, np.broadcast_to(now, array.shape))
    for label, array in found(result).items():
        np.testing.assert_array_equal(array, before[label], err_msg=label)


def test_certified_arrays_cannot_be_written():
    c = certify(F, UV, loops=LOOPS)
    problem = Problem(V, F, RIM, UV[RIM])
    for array in (c.F, c.uv, *c.loops, problem.F, *problem.domain.loops, problem.domain.edges.interior):
        assert not array.flags.writeable
    for array in (c.F, problem.F, c.F[3:]):
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            array.flags.writeable = True
    assert LOOPS[0].flags.writeable


@pytest.mark.parametrize("again", [lambda c: c, copy.copy, copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
@pytest.mark.parametrize("uv", [UV, UV * [-1, 1], np.where(np.arange(len(UV))[:, None] == RIM[0], np.nan, UV)])
@pytest.mark.parametrize("by", ["certify", "certify_each"])
def test_no_array_of_a_certificate_can_be_made_writeable(by, uv, again):
    c = again(certify(F, uv, loops=LOOPS) if by == "certify" else certify_each([F], [uv], [LOOPS])[0])
    for array in found(c).values():
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            array.flags.writeable = True


def test_immutable_triangles_are_not_copied():
    domain = Domain(V, F, RIM)
    c = certify(domain.F, UV)
    assert np.shares_memory(c.F, domain.F)
    assert np.shares_memory(certify(c.F, UV).F, domain.F)
    assert not np.shares_memory(certify(F, UV).F, F)


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
