"""Success, message, energy and tables of results; what may be omitted from a call."""

from __future__ import annotations

import pickle
import re
import sys
from dataclasses import replace
from inspect import isfunction, signature

import numpy as np
import pytest

import quasiharmonic as qh
from quasiharmonic import Problem, Status, distortion, io, results
from quasiharmonic.atlas import SeamedMesh, as_seamed_mesh
from quasiharmonic.atlas import flatten as flatten_islands
from quasiharmonic.surfaces import cat, disk
from quasiharmonic.util.outcome import Verdict
from shared.polygons import circle


def star(count, depth=0.5):
    """Positions (count, 2) on a star with five tips."""
    angle = 2 * np.pi * np.arange(count) / count
    return (1 + depth * np.cos(5 * angle))[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.fixture(scope="module")
def surface():
    V, F = cat(8)
    return V, F, qh.boundary_loops(F, len(V))[0]


@pytest.fixture(scope="module")
def solved(surface):
    V, F, loop = surface
    return qh.injective_map(V, F, loop, star(len(loop)))


def test_a_certified_map_is_a_success(solved):
    assert solved
    assert solved.success
    assert solved.converged
    assert solved.message == solved.status.value
    assert solved.energy < 1e-20


def test_a_map_with_inverted_triangles_is_none(surface):
    V, F, loop = surface
    result = qh.injective_map(V, F, loop, star(len(loop))[::-1])
    assert not result
    assert not result.converged
    assert result.message == Status.IMPOSSIBLE.value
    assert result.energy > 1


@pytest.mark.parametrize("status", list(Status))
def test_only_collapse_and_interruption_make_an_injective_map_a_failure(solved, status):
    result = replace(solved, status=status)
    assert result.success == (status not in (Status.COLLAPSED, Status.INTERRUPTED))
    assert bool(result) == result.success
    assert result.to_dict()["success"] is result.success


def test_an_interrupted_polish_is_not_a_success(surface, solved):
    def interrupt(step):
        raise KeyboardInterrupt

    V, F, _ = surface
    result = qh.polish(V, F, solved.uv, callback=interrupt)
    assert result.status is Status.INTERRUPTED
    assert result.injective
    assert not result


@pytest.mark.parametrize("call", [qh.polish, qh.flatten])
def test_the_energy_of_a_result_is_the_mean_of_the_measure(surface, solved, call):
    V, F, _ = surface
    result = call(V, F, solved.uv, energy="mips") if call is qh.polish else call(V, F, energy="mips")
    assert result.energy == pytest.approx(distortion(V, F, result.uv).statistics("mips").mean, rel=1e-9)


@pytest.mark.parametrize("energy", ["symmetric-dirichlet", "mips", "blend", "arap-barrier"])
def test_energies_vanish_at_isometries(energy):
    V, F = disk(4)
    assert abs(qh.polish(V, F, 3 * V + 1, energy=energy).energy) < 1e-12
    assert abs(qh.flatten(V, F, energy=energy).energy) < 1e-12


def test_discarded_stages_do_not_change_the_energy(surface):
    V, F, _ = surface
    flat = qh.flatten(V, F)
    result = qh.harmonise(V, F, flat.uv, energy="arap", max_iterations=1)
    assert result.status is Status.UNIMPROVED
    np.testing.assert_array_equal(result.uv, flat.uv)
    assert result.energy == result.history[0].energy


@pytest.mark.slow
@pytest.mark.parametrize("call", [qh.polish, qh.harmonise])
def test_the_boundary_is_fixed_by_default(surface, solved, call):
    V, F, loop = surface
    given, default = call(V, F, solved.uv, fixed=np.sort(loop)), call(V, F, solved.uv)
    np.testing.assert_array_equal(default.uv, given.uv)
    np.testing.assert_array_equal(default.uv[loop], solved.uv[loop])


def test_the_boundary_is_fixed_by_default_in_derivatives(surface, solved):
    V, F, loop = surface
    uv = qh.polish(V, F, solved.uv).uv
    change = np.ones_like(uv)
    default = qh.polish_derivative(V, F, uv).vjp(change)
    given = qh.polish_derivative(V, F, uv, fixed=np.sort(loop)).vjp(change)
    np.testing.assert_array_equal(default.rest, given.rest)
    np.testing.assert_array_equal(default.target, given.target)


def test_a_problem_needs_fixed_vertices(surface):
    V, F, loop = surface
    with pytest.raises(ValueError, match="fixed must list the vertices"):
        Problem(V, F, None, star(len(loop)))


def test_diagnose_accepts_what_injective_map_accepts(surface):
    V, F, loop = surface
    target = star(len(loop))[::-1]
    expected = qh.diagnose(Problem(V, F, loop, target)).to_dict()
    assert qh.diagnose(V, F, loop, target).to_dict() == expected
    assert qh.diagnose(V, F, fixed=loop, target=target, reference="equilateral").to_dict() == expected
    with pytest.raises(TypeError, match="no further arguments"):
        qh.diagnose(Problem(V, F, loop, target), loop)


def test_animations_are_sequences(surface):
    V, F, loop = surface
    animation = qh.animate(Problem(V, F, loop, star(len(loop))), [star(len(loop), d) for d in (0.1, 0.2, 0.3)])
    assert animation
    assert len(animation) == 3
    assert animation[-1] is animation.frames[2]
    assert list(animation) == animation[:] == animation.frames
    assert "3 frames" in animation.message
    table = animation.to_dataframe()
    assert table.index.name == "frame"
    assert list(table["status"]) == ["injective"] * 3
    np.testing.assert_array_equal(table["move"][1:], animation.moves)


def test_a_missing_or_interrupted_frame_fails_an_animation(surface):
    V, F, loop = surface
    problem = Problem(V, F, loop, star(len(loop)))
    assert not qh.animate(problem, [star(len(loop)), star(len(loop))[::-1]])
    complete = qh.animate(problem, [star(len(loop))])
    assert not replace(complete, interrupted=True)


@pytest.mark.slow
def test_an_atlas_is_a_success_if_all_islands_are(surface):
    V, F, _ = surface
    two = SeamedMesh(np.concatenate([V, V + 5]), np.concatenate([F, F + len(V)]))
    mapped = flatten_islands(two)
    assert mapped
    assert mapped.verdict().to_dataframe()["triangles"].tolist() == [len(F), len(F)]
    failed = replace(mapped.islands[0], result=replace(mapped.islands[0].result, status=Status.COLLAPSED))
    assert not replace(mapped, islands=(failed, mapped.islands[1]))
    assert not replace(mapped, islands=mapped.islands[:1])


def test_repairs_and_morphs_have_success_and_message(surface, solved):
    V, F, loop = surface
    broken = solved.uv.copy()
    inner = np.setdiff1d(np.arange(len(V)), loop)
    broken[inner[0]] += 5
    repaired = qh.repair(V, F, broken)
    assert repaired
    assert repaired.message.startswith("1 island")
    flat, G = disk(4)
    rim = qh.boundary_loops(G, len(flat))[0]
    moved = qh.morph(flat, G, rim, flat[rim] * [2, 1])
    assert moved
    assert "inverted" in moved.message
    assert moved.status is moved.result.status
    assert not qh.morph(flat, G, rim, flat[rim[::-1]])


@pytest.mark.slow
def test_distortion_converts_to_a_dataframe(surface, solved, tmp_path):
    V, F, _ = surface
    measured = distortion(V, F, solved.uv)
    table = measured.to_dataframe()
    assert table.shape == (len(F), 10)
    np.testing.assert_array_equal(table["mips"], measured.mips)
    table.to_csv(tmp_path / "table.csv")
    assert (tmp_path / "table.csv").read_text().startswith("triangle,share,sigma1")
    heading, *lines = measured.summary().splitlines()
    assert heading.split() == ["median", "95", "%", "max"]
    assert {line.split()[0] for line in lines} == set(measured.per_triangle())
    assert float(dict(line.split(maxsplit=1) for line in lines)["mips"].split()[2]) == pytest.approx(
        measured.mips.max(), rel=1e-3
    )


def test_a_missing_pandas_gives_the_install_command(surface, solved, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    V, F, _ = surface
    with pytest.raises(ImportError, match=r"pip install '.*\[pandas\]'"):
        distortion(V, F, solved.uv).to_dataframe()


def test_results_convert_to_trimesh(surface, solved):
    V, F, _ = surface
    made = solved.to_trimesh()
    np.testing.assert_array_equal(made.vertices, V)
    np.testing.assert_array_equal(made.faces, F)
    np.testing.assert_array_equal(made.visual.uv, solved.uv)
    flat, G = disk(3)
    assert not qh.flatten(flat, G).to_trimesh().vertices[:, 2].any()
    with pytest.raises(ValueError, match="no rest positions"):
        replace(solved, V=None).to_trimesh()


def test_results_pickle(surface, solved):
    V, F, loop = surface
    flat, G = disk(3)
    for result in (
        solved,
        distortion(V, F, solved.uv),
        qh.animate(Problem(V, F, loop, star(len(loop))), [star(len(loop))]),
        flatten_islands(SeamedMesh(V, F)),
        qh.repair(V, F, solved.uv),
        qh.diagnose(V, F, loop, star(len(loop))[::-1]),
        qh.InverseMap(flat, G, flat),
    ):
        again = pickle.loads(pickle.dumps(result))
        assert type(again) is type(result)
        if hasattr(result, "uv"):
            np.testing.assert_array_equal(again.uv, result.uv)


def test_every_name_of_the_results_module_exists():
    assert all(isinstance(getattr(results, name), type) for name in results.__all__)
    shared = set(results.__all__) & set(qh.__all__)
    assert "MapResult" in shared
    assert all(getattr(results, name) is getattr(qh, name) for name in shared)


def test_the_results_module_has_every_class_that_a_function_returns():
    returned = set()
    for module in (qh, qh.atlas):
        functions = [one for name in module.__all__ if isfunction(one := getattr(module, name))]
        returned |= {name for one in functions for name in re.findall(r"\w+", signature(one).return_annotation)}
    modules = results, qh, qh.atlas
    classes = {name for name in returned if any(isinstance(getattr(one, name, None), type) for one in modules)}
    # A mesh is no result.
    classes -= {"SeamedMesh"}
    assert {"MapResult", "Derivative", "Distortion", "InverseVolume", "AtlasVerdict"} <= classes
    assert classes <= set(results.__all__)
    assert {one.__name__ for one in Verdict.__subclasses__()} <= set(results.__all__)


def test_a_circle_is_its_own_map():
    V, F = disk(5)
    loop = qh.boundary_loops(F, len(V))[0]
    assert qh.injective_map(V, F, loop, circle(len(loop))).success


class Triangles:
    """A mesh object of another library."""

    def __init__(self, V, F):
        self.vertices, self.faces = V, F


def test_meshes_are_accepted_in_place_of_arrays(surface, solved, tmp_path):
    V, F, loop = surface
    target = star(len(loop))
    path = tmp_path / "mesh.obj"
    io.write_map(path, Triangles(V, F), solved)
    np.testing.assert_array_equal(io.map_of(io.read_mesh(path)), solved.uv)
    io.write_map(tmp_path / "again.obj", path, solved.uv)
    assert (tmp_path / "again.obj").read_bytes() == path.read_bytes()
    for mesh in (Triangles(V, F), path):
        np.testing.assert_array_equal(qh.boundary_loops(mesh)[0], loop)
        (result,) = qh.injective_maps([(mesh, loop, target)])
        np.testing.assert_array_equal(result.uv, solved.uv)
        np.testing.assert_array_equal(as_seamed_mesh(mesh).V, V)
    np.testing.assert_array_equal(as_seamed_mesh(path).islands[0].uv, solved.uv)
    assert as_seamed_mesh(mapped := as_seamed_mesh(path)) is mapped
    with pytest.raises(TypeError):
        SeamedMesh(path)
    np.testing.assert_array_equal(qh.boundary_loops(F)[0], loop)


def test_malformed_arguments_of_boundary_loops_are_named(surface):
    _, F, _ = surface
    with pytest.raises(ValueError, match="F refers to"):
        qh.boundary_loops(F, 3)
    with pytest.raises(ValueError, match=r"must have shape \(f, 3\)"):
        qh.boundary_loops([0, 1, 2])


@pytest.mark.parametrize(
    "call",
    [qh.solve, qh.quasi_harmonic_map, qh.quasi_harmonic_derivative, qh.refine_problem, lambda p: qh.animate(p, [])],
)
def test_what_is_not_a_problem_is_named(call):
    with pytest.raises(TypeError, match="takes a Problem, not None"):
        call(None)


@pytest.mark.parametrize("option", [{"linear_solver": ["x"]}, {"energy": []}, {"energy": np.zeros(3)}])
def test_options_of_other_types_are_named(surface, solved, option):
    V, F, _ = surface
    for call in (qh.polish, qh.harmonise):
        with pytest.raises(ValueError, match=next(iter(option))):
            call(V, F, solved.uv, **option)


def test_results_have_a_short_repr(surface, solved):
    V, F, loop = surface
    flat, G = disk(3)
    rim = qh.boundary_loops(G)[0]
    for result in (
        qh.morph(flat, G, rim, flat[rim]),
        qh.repair(V, F, solved.uv),
        flatten_islands(SeamedMesh(V, F)),
        flatten_islands(SeamedMesh(V, F)).verdict(),
        qh.inspect_mesh(V, F),
        qh.refine_problem(Problem(V, F, loop, star(len(loop)))),
        qh.nearest_invertible(np.zeros((4, 4, 2))),
    ):
        assert repr(result).startswith(f"<{type(result).__name__}: ")
        assert len(repr(result)) < 300
