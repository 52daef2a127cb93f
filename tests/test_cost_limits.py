"""Limits for the cost of a solve: factorisations, solves, allocations, imports. These counts do not use a clock."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from collections import Counter

import numpy as np
import pytest

from quasiharmonic import Problem, boundary_loops, certify, io, solve
from quasiharmonic.geometry.coarsening import coarsen
from quasiharmonic.geometry.prolongation import prolong
from quasiharmonic.linsolve import LinearSolver, available
from quasiharmonic.solver.field.objective import Objective
from quasiharmonic.solver.methods import VectorAdam
from quasiharmonic.solver.search.search import allowed_repairs
from quasiharmonic.surfaces import disk
from quasiharmonic.targets import arc_length, letter, rectangle, star
from quasiharmonic.targets import disk as circle
from quasiharmonic.util.kernels import extension
from shared.meshes import lift


def posed(rings, character):
    V, F = disk(rings)
    (loop,) = boundary_loops(F, len(V))
    return lift(V), F, loop, arc_length(V[loop], letter(character)[0])


@pytest.fixture
def counted(monkeypatch):
    """Count how often matrices of each size are analysed, factored and solved with."""
    counts = Counter()

    def count(name, method):
        def counting(solver, *arguments, **named):
            out = method(solver, *arguments, **named)
            counts[name, solver.n] += 1
            return out

        monkeypatch.setattr(LinearSolver, method.__name__, counting)

    count("analyse", LinearSolver.__init__)
    count("factor", LinearSolver.factor)
    count("solve", LinearSolver.solve)
    return counts


# Rings of the disk, outline; number of iterations. The smallest mesh is not coarsened, the largest is at once.
@pytest.mark.parametrize(
    ("rings", "character", "most"), [(20, "C", 2), (20, "S", 5), (30, "R", 56), (50, "C", 3), (50, "R", 79)]
)
def test_factorisations(counted, rings, character, most):
    problem = Problem(*posed(rings, character))
    result = solve(problem)
    assert result.injective
    # Other orders of summation on other machines may take a few more.
    most = most + 2 + most // 5
    fine = problem.n - problem.fixed.size
    sizes = sorted({size for _, size in counted})
    bounds = {sizes[0]: most + 1}
    if rings == 50:
        assert sizes[0] < 0.1 * fine
        # Positions in both directions, if a coarse map is polished before its prolongation.
        bounds[2 * sizes[0]] = 11
    else:
        assert sizes == [fine]
        # The start and the composite, if tried, take one more each; a map with relocated vertices takes none.
        assert counted["factor", fine] == counted["solve", fine]
        assert result.n_iterations <= counted["factor", fine] <= result.n_iterations + 2
    assert sizes == sorted(bounds)
    for (kind, size), times in counted.items():
        assert times <= (1 if kind == "analyse" else bounds[size]), (kind, size)


def test_a_moved_target_is_not_analysed_again_and_starts_near_its_solution(counted):
    V, F = disk(20)
    (loop,) = boundary_loops(F, len(V))
    strip = arc_length(V[loop], rectangle(8.0, 1.0))

    def bent(angle):
        turn = (strip[:, 0] / 8 - 0.5) * angle
        return (8 / angle + 0.5 - strip[:, 1])[:, None] * np.stack([np.sin(turn), -np.cos(turn)], axis=1)

    problem = Problem(V, F, loop, bent(3.0))
    last = solve(problem)
    fine = problem.n - problem.fixed.size
    assert last.injective
    assert last.n_iterations > 0
    counted.clear()
    for angle in np.linspace(3.1, 5.0, 20):
        problem = problem.with_target(bent(angle))
        last = solve(problem, start=last.uv)
        assert last.injective
    assert counted["analyse", fine] == 0
    assert counted["factor", fine] <= 22


class TestStart:
    def test_is_where_the_search_begins(self):
        problem = Problem(*posed(12, "C"))
        found = solve(problem)
        again = solve(problem, start=found.uv)
        assert again.n_iterations == 0
        np.testing.assert_allclose(again.uv, found.uv, atol=1e-6)

    def test_a_useless_start_does_no_harm(self):
        problem = Problem(*posed(12, "S"))
        everything_in_a_point = np.zeros((problem.n, 2))
        assert solve(problem, start=everything_in_a_point).injective
        mirrored = solve(problem).uv * [-1, 1]
        result = solve(problem, start=mirrored)
        assert result.injective

    @pytest.mark.parametrize(
        ("start", "words"),
        [(np.zeros((3, 2)), r"start must have shape \(\d+, 2\)"), (np.nan, "start is not finite at vertices 0, 1")],
    )
    def test_invalid_starts_are_rejected(self, start, words):
        problem = Problem(*posed(4, "C"))
        start = np.full((problem.n, 2), start) if np.ndim(start) == 0 else start
        with pytest.raises(ValueError, match=words):
            solve(problem, start=start)


def peak(call, *arguments):
    """Return the peak of allocated bytes during a call, over those before and after it, and its result."""
    tracemalloc.start()
    try:
        out = call(*arguments)
        return tracemalloc.get_traced_memory()[1], out
    finally:
        tracemalloc.stop()


class TestAllocations:
    """Peak bytes per triangle, without the memory that libraries allocate themselves."""

    def test_many_corners_of_an_outline(self):
        most, placed = peak(lambda: arc_length(circle(1.0, 12000), star(3000)))
        assert most < 1000 * len(placed)

    def test_problem(self):
        arrays = posed(80, "C")
        Problem(*arrays)
        assert peak(Problem, *arrays)[0] / len(arrays[1]) < 220

    @pytest.mark.slow
    def test_iteration(self):
        problem = Problem(*posed(80, "C"))
        objective = Objective(problem)
        start = objective.evaluate(np.zeros(len(problem.F), dtype=np.complex128))

        def iterate():
            # The certificate of each map is a part of its cost.
            path = VectorAdam(iterations=3, schedule=((0, 0.1),)).iterates(objective, start)
            assert sum(here.inverted < len(problem.F) for here in path) == 3

        iterate()
        # SuperLU's factor is included: SciPy returns a copy of it, from which the signs of the pivots are read.
        most = 650 if objective.laplacian.solver.name == "superlu" else 205
        assert peak(iterate)[0] / len(problem.F) < most

    def test_coarsening_and_prolongation(self):
        V, F, loop, _ = posed(80, "C")
        held = np.zeros(len(V), dtype=bool)
        held[loop] = True
        most, coarse = peak(coarsen, F, len(V), held, 1500)
        assert most / len(F) < 160
        most, _ = peak(prolong, V[:, 0] + 1j * V[:, 1], coarse, held)
        assert most / len(F) < 150

    def test_certificate(self):
        V, F, _, _ = posed(80, "C")
        # 24 of these bytes are the read-only copy of F.
        assert peak(certify, F, V[:, :2].copy())[0] / len(F) < 214

    @pytest.mark.long
    def test_peak_memory_grows_linearly_with_the_triangles(self):
        small, large = (posed(rings, "C") for rings in (60, 120))
        solve(Problem(*small))
        first, second = (peak(lambda a: solve(Problem(*a)), arrays)[0] / len(arrays[1]) for arrays in (small, large))
        assert second < 1.1 * first


class TestImports:
    def modules(self, code):
        code += "; import sys; print(*(name for name in sys.modules))"
        return set(
            subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
        )

    def test_importing_the_library_imports_nothing_else(self):
        found = self.modules("import quasiharmonic")
        assert not found & {"numpy", "scipy", "matplotlib", "quasiharmonic.solver.search.search"}
        assert len(found - self.modules("pass")) < 60

    @pytest.mark.slow
    def test_help_imports_nothing_else(self):
        found = self.modules("from quasiharmonic.ui.cli import COMMANDS, parser_of; parser_of(COMMANDS).format_help()")
        assert not found & {"numpy", "scipy", "matplotlib", "quasiharmonic.solver.search.search"}
        assert len(found - self.modules("pass")) < 140

    @pytest.mark.long
    def test_workers_of_a_data_set_start_without_slow_imports(self):
        found = self.modules("import quasiharmonic.ui.batch.worker")
        assert not found & {"matplotlib", "scipy.optimize", "scipy.spatial", "scipy.fft", "shapely", "pyarrow"}

    @pytest.mark.slow
    def test_a_solve_imports_only_what_it_needs(self):
        found = self.modules("from quasiharmonic import injective_map")
        assert not found & {"matplotlib", "scipy.optimize", "scipy.spatial", "scipy.sparse.csgraph", "scipy.linalg"}

    @pytest.mark.long
    def test_the_command_unwraps_a_flat_model_without_slow_imports(self, tmp_path):
        V, F = disk(2)
        io.write_obj(tmp_path / "mesh.obj", io.MeshData(V, F))
        words = ["unwrap", str(tmp_path / "mesh.obj"), "-o", str(tmp_path / "out.obj")]
        found = self.modules(f"from quasiharmonic.ui.cli import main; assert main({words!r}) == 0")
        assert not found & {"matplotlib", "dask", "scipy.optimize", "shapely", "pyarrow"}
        assert not found & {"quasiharmonic.solver.search.search", "quasiharmonic.ui.batch", "quasiharmonic.io.fem.vtu"}
        assert len([name for name in found if name.startswith("quasiharmonic")]) < 240

    @pytest.mark.long
    @pytest.mark.parametrize("letter", [None, "R", pytest.param("C", marks=pytest.mark.nightly)])
    def test_the_command_maps_a_small_mesh_without_slow_imports(self, letter, tmp_path):
        """No time is measured; SciPy's subpackages and matplotlib would take longer than the map."""
        if available()[0] == "superlu":
            pytest.skip("the one solver here is a part of scipy.sparse.linalg, which loads them")
        V, F = disk(13)
        uv = V[:, :2] * (1 + 0.5 * V[:, :1])
        io.write_obj(tmp_path / "mesh.obj", io.MeshData(V, F).with_map(uv))
        to = [] if letter is None else ["--to", f"letter:{letter}"]
        words = ["map", str(tmp_path / "mesh.obj"), *to, "-o", str(tmp_path / "map.obj"), "--json", str(tmp_path / "j")]
        found = self.modules(f"from quasiharmonic.ui.cli import main; assert main({words!r}) == 0")
        assert not found & {"matplotlib", "scipy.optimize", "scipy.spatial", "scipy.sparse.csgraph", "scipy.linalg"}
        assert not found & {"scipy.sparse.linalg", "quasiharmonic.ui.cli.commands.flatten", "quasiharmonic.plot"}
        if available()[0] == "mkl" and extension is not None:
            # The other solvers take SciPy's matrices.
            assert "scipy" not in found
        if letter == "R":
            # Modules needed for a map to it; without them, the absence of Qhull would prove nothing.
            assert "composite" in (tmp_path / "j").read_text()


@pytest.mark.slow
def test_repairs_cost_less_where_boundary_vertices_share_a_position():
    V, F = disk(2)
    (loop,) = boundary_loops(F, len(V))
    simple, touching = Problem(V, F, loop, V[loop]), V.copy()
    touching[15] = touching[8]
    crossing = Problem(lift(V), F, loop, touching[loop])
    assert 8 * allowed_repairs(crossing, 100) == allowed_repairs(simple, 100)
    result = solve(crossing)
    assert not result.injective
