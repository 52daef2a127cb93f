"""Arguments of public functions: arrays changed by another thread, arrays that stay unchanged, invalid indices."""

from __future__ import annotations

import copy
import ctypes
import pickle
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest

from quasiharmonic import (
    AirMesh,
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
)
from quasiharmonic.atlas import SeamedMesh
from quasiharmonic.energies.deformation import DeformationEnergy
from quasiharmonic.energies.energies import ARAP
from quasiharmonic.geometry.exact.loops import contacts
from quasiharmonic.geometry.mesh.reference import ReferenceMesh, operators
from quasiharmonic.geometry.mesh.topology import boundary_loops, components
from quasiharmonic.linsolve.laplacian import Laplacian
from quasiharmonic.problem import Domain
from shared.caller_arrays import LOOPS, RIM, SQUARE, UV, F, V

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


@pytest.mark.long
@pytest.mark.parametrize("seconds", [0.08, pytest.param(1, marks=pytest.mark.nightly)])
def test_triangles_that_another_thread_overwrites(seconds):
    text = REWRITTEN.format(calls=CALLS, seconds=seconds)
    ran = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, (ran.returncode, ran.stdout.splitlines()[-1:], ran.stderr[-2000:])
    counts = [line.split()[-2:] for line in ran.stdout.splitlines()]
    assert len(counts) == len(CALLS)
    # Some calls met the invalid indices; in a short time on a busy machine perhaps none.
    assert sum(int(refused) for _, refused in counts) > 0 or seconds < 1


# Calls of kernels that require valid indices.
KERNELS = {
    "geometry.exact.triangles": ["sure_signs", "count_turns"],
    "geometry.exact.loops": ["doubtful_pairs"],
    "geometry.mesh.topology": ["sort_edges", "number_sides", "link_nodes", "follow_loops"],
    "geometry.mesh.reference": ["lay_flat", "wirtinger"],
    "energies.deformation": ["jacobians", "pulls", "collapses"],
    "linsolve.laplacian": ["find_pattern", "assemble", "boundary_load", "put_at"],
    "geometry.exact.point_location": ["sure_hits", "find_cells", "divide_cells"],
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
def test_no_array_of_a_certificate_can_be_made_writeable(uv, again):
    c = again(certify(F, uv, loops=LOOPS))
    for array in found(c).values():
        with pytest.raises(ValueError, match="cannot set WRITEABLE"):
            array.flags.writeable = True


def test_immutable_triangles_are_not_copied():
    domain = Domain(V, F, RIM)
    c = certify(domain.F, UV)
    assert np.shares_memory(c.F, domain.F)
    assert np.shares_memory(certify(c.F, UV).F, domain.F)
    assert not np.shares_memory(certify(F, UV).F, F)
