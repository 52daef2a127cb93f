"""Tetrahedral meshes with a moved boundary, and maps onto a given boundary."""

from functools import cache
from types import SimpleNamespace

import meshlane
import numpy as np
import pytest

from quasiharmonic import MovingMesh, certify_tetrahedra, injective_tetrahedra, morph
from quasiharmonic.apps.tetrahedra.contacts import edges_meeting_triangles
from quasiharmonic.apps.tetrahedra.descent import BlockMatrix, ShapeEnergy, reduce_epsilon, regularise
from quasiharmonic.apps.tetrahedra.result import TetrahedraStatus, tetrahedron_quality
from quasiharmonic.io.fem.files import read_volume
from quasiharmonic.ui.cli import main
from shared.exact_space import contact, cross, exact, minus
from shared.tetrahedral_meshes import box, sphere_points


def shell(k=5):
    """A cube with one cell as its cavity, in the middle or next to it, and the cavity's vertices."""
    X, T = box(k, k, k)
    rng = np.random.default_rng(0)
    inner = (X > 0).all(axis=1) & (X < 1).all(axis=1)
    centre = (k // 2 + 0.5) / k
    T = T[np.abs(X[T].mean(axis=1) - centre).max(axis=1) > 0.5 / k]
    cavity = np.flatnonzero(np.abs(X - centre).max(axis=1) < 0.6 / k)
    assert len(cavity) == 8
    inner[cavity] = False
    X[inner] += 0.1 / k * rng.uniform(-1, 1, (inner.sum(), 3))
    return X, T, cavity


def turned(X, degrees):
    a, centre = np.radians(degrees), X.mean(axis=0)
    return (X - centre) @ np.array([(np.cos(a), np.sin(a), 0), (-np.sin(a), np.cos(a), 0), (0, 0, 1)]) + centre


@pytest.mark.parametrize("epsilon", [0.0, 0.01, 0.5])
def test_derivatives_agree_with_differences(epsilon):
    rng = np.random.default_rng(1)
    X, T = box(2, 2, 2)
    energy = ShapeEnergy(T, X)
    Y = X + (0.03 if epsilon == 0 else 0.3) * rng.normal(size=X.shape)
    assert (energy.determinants(Y).min() > 0) == (epsilon == 0)
    value, gradient, blocks = energy.derivatives(Y, epsilon)
    assert value == pytest.approx(energy.value(Y, epsilon), rel=1e-14)
    for _ in range(5):
        step = rng.normal(size=X.shape)
        h = 1e-6
        difference = (energy.value(Y + h * step, epsilon) - energy.value(Y - h * step, epsilon)) / (2 * h)
        assert difference == pytest.approx((gradient * step).sum(), rel=1e-6)
    # The matrix is symmetric and positive semidefinite.
    assembly = BlockMatrix(T, len(X), np.arange(len(X)))
    matrix = assembly.matrix(assembly.assemble(blocks)).toarray()
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[0] > -1e-12 * np.abs(matrix).max()


def test_the_matrix_is_the_second_derivative_without_that_of_the_determinant():
    """At a rotation the derivative in the determinant is zero, so the matrix is the exact second derivative."""
    rng = np.random.default_rng(2)
    X, T = box(1, 1, 1)
    energy = ShapeEnergy(T, X)
    free = np.arange(2, 7)
    Y = turned(X, 30)
    _, _, blocks = energy.derivatives(Y, 0.0)
    assembly = BlockMatrix(T, len(X), free)
    matrix = assembly.matrix(assembly.assemble(blocks)).toarray()
    step = np.zeros_like(X)
    step[free] = rng.normal(size=(5, 3))
    h = 1e-5
    up, down = (energy.derivatives(Y + sign * h * step, 0.0)[1] for sign in (1, -1))
    shape = matrix @ step[free].ravel()
    # The density's derivative in D at a rotation is -1/3, from the shape term; it adds the derivative of cofactors.
    expected = ((up - down) / (2 * h))[free].ravel()
    cofactors = energy_of_determinants(energy, Y, step, h)[free].ravel()
    np.testing.assert_allclose(shape - cofactors / 3, expected, atol=1e-6)


def energy_of_determinants(energy, Y, step, h):
    """Derivative along a step of the gradient of the mean determinant, by differences of its values."""
    gradient = np.zeros((2, *Y.shape))
    for k, sign in enumerate((1, -1)):
        Z = Y + sign * h * step
        for i in range(len(Y)):
            for a in range(3):
                up, down = Z.copy(), Z.copy()
                up[i, a] += 1e-3
                down[i, a] -= 1e-3
                gradient[k, i, a] = (energy.determinants(up).mean() - energy.determinants(down).mean()) / 2e-3
    return (gradient[0] - gradient[1]) / (2 * h)


def test_the_regularisation_parameter():
    D = np.array([-1e8, -1.0, 0.0, 1.0, 1e8])
    np.testing.assert_allclose(regularise(D, 1.0), [2.5e-9, (np.sqrt(2) - 1) / 2, 0.5, (np.sqrt(2) + 1) / 2, 1e8])
    # The rule multiplies χ of the least determinant by the energy's ratio, at most by 0.9.
    for ratio, factor in ((0.5, 0.5), (0.99, 0.9)):
        now = reduce_epsilon(0.3, -0.2, ratio)
        assert regularise(np.array(-0.2), now) == pytest.approx(factor * regularise(np.array(-0.2), 0.3))
    assert reduce_epsilon(0.3, 0.5, 0.5) == 0.0


@pytest.mark.slow
def test_a_turned_cavity():
    X, T, cavity = shell()
    start = X.copy()
    start[cavity] = turned(X[cavity], 70)
    assert len(certify_tetrahedra(T, start).inverted)
    result = morph(X, T, cavity, start[cavity])
    assert result.success
    assert result.status is TetrahedraStatus.POLISHED
    assert result.certificate.injective
    np.testing.assert_array_equal(result.points[cavity], start[cavity])
    walls = (X == 0).any(axis=1) | (X == 1).any(axis=1)
    np.testing.assert_array_equal(result.points[walls], X[walls])
    assert result.quality_after.min() > 0
    # No step lowers the energy: the free forces vanish.
    first = morph(X, T, cavity, start[cavity], energy=None)
    assert first.success
    assert first.energy > result.energy
    # A longer cavity turn in steps, with the mesh carried along.
    mesh = MovingMesh(X, T, cavity)
    for angle in (60, 120):
        mesh.advance(turned(X[cavity], angle))
    assert certify_tetrahedra(mesh.F, mesh.points).injective
    before = mesh.points
    with pytest.raises(RuntimeError, match="stay inverted"):
        mesh.advance(X[cavity] + 10.0)
    np.testing.assert_array_equal(mesh.points, before)


@pytest.mark.slow
@pytest.mark.parametrize("while_inverted", [True, False])
def test_ctrl_c_returns_the_best_mesh_so_far(while_inverted):
    X, T, cavity = shell()
    seen = []

    def stop(step):
        seen.append(step.inverted)
        if step.iteration and (step.inverted > 0) == while_inverted:
            raise KeyboardInterrupt

    result = morph(X, T, cavity, turned(X[cavity], 150), callback=stop)
    assert result.status is TetrahedraStatus.INTERRUPTED
    assert not result.success
    assert len(result.inverted) == min(seen)
    assert result.valid == (not while_inverted)


@cache
def turned_by_40():
    X, T, cavity = shell(4)
    return morph(X, T, cavity, turned(X[cavity], 40))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-100, 1e100])
def test_the_scale_does_not_matter(scale):
    X, T, cavity = shell(4)
    plain = turned_by_40()
    scaled = morph(X * scale, T, cavity, turned(X[cavity], 40) * scale)
    assert scaled.success
    np.testing.assert_allclose(scaled.points / scale, plain.points, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [5e5, 1e8])
def test_the_origin_does_not_matter(offset):
    X, T, cavity = shell(4)
    plain = turned_by_40()
    moved = morph(X + offset, T, cavity, turned(X[cavity], 40) + offset)
    assert moved.success
    np.testing.assert_allclose(moved.points - offset, plain.points, atol=1e-7 + 100 * np.spacing(offset))
    assert moved.energy == pytest.approx(plain.energy, rel=1e-3)


@pytest.mark.slow
def test_a_mesh_that_stays_where_it_is_has_converged():
    X, T, cavity = shell(4)
    result = morph(X, T, cavity, X[cavity])
    assert result.status is TetrahedraStatus.POLISHED
    np.testing.assert_array_equal(result.points, X)


def test_a_mesh_that_overlaps_itself_is_no_success():
    X, T = box(1, 1, 1)
    X, T = np.concatenate([X, X + np.array([2, 0, 0])]), np.concatenate([T, T + len(X)])
    other = np.arange(8, 16)
    result = injective_tetrahedra(X, T, other[:4], X[other[:4]] - (1.5, 0, 0))
    assert result.valid
    assert not result.success
    assert result.status is TetrahedraStatus.OVERLAPPING


@pytest.mark.slow
def test_a_known_diffeomorphism_is_found():
    X, T = box(4, 4, 4)
    boundary = np.unique(certify_tetrahedra(T, X).boundary)
    a = 2.5 * (X[:, 2] - 0.5)
    x, y = (X[:, 0] - 0.5) * (1 + X[:, 2]), X[:, 1] - 0.5
    Y = np.stack([np.cos(a) * x - np.sin(a) * y, np.sin(a) * x + np.cos(a) * y, X[:, 2] + 0.2 * x * x], axis=1)
    assert certify_tetrahedra(T, Y).injective
    rng = np.random.default_rng(0)
    begin = rng.random(X.shape)
    result = injective_tetrahedra(X, T, boundary, Y[boundary], start=begin)
    assert result.success
    assert result.iterations > 0
    assert bool(result)
    # Rows in any orientation are accepted, and a start that is valid is returned if it is not polished.
    again = injective_tetrahedra(X, T[:, [1, 0, 2, 3]], boundary, Y[boundary], start=Y, polish=False)
    np.testing.assert_allclose(again.points, Y, rtol=0, atol=0)
    assert again.success


@pytest.mark.slow
def test_a_boundary_that_crosses_itself_is_reported_before_any_search():
    X, T, cavity = shell()
    result = morph(X, T, cavity, X[cavity] + (0.5, 0, 0))
    assert result.status is TetrahedraStatus.CROSSING
    assert result.iterations == 0
    assert "meet" in result.obstructions[0].text
    assert len(result.certificate.crossings)


def test_a_tetrahedron_of_fixed_vertices_is_named():
    corner = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (0.1, 0.1, 0.1)])
    star = [[0, 1, 2, 4], [0, 3, 1, 4], [0, 2, 3, 4], [1, 3, 2, 4]]
    moved = corner.copy()
    moved[4] = (1, 1, 1)
    result = injective_tetrahedra(corner, star, np.arange(5), moved)
    assert result.status is TetrahedraStatus.IMPOSSIBLE
    assert result.forbidden.tolist() == [3]
    assert "its four vertices are fixed" in result.summary()
    assert result.to_dict()["status"] == "impossible"


def test_an_edge_of_fixed_vertices_at_one_position_is_named():
    X, T = box(4, 4, 4)
    result = injective_tetrahedra(X, T, [62, 63], [(0.5, 0.5, 0.5)] * 2)
    assert result.status is TetrahedraStatus.IMPOSSIBLE
    assert "Both ends of the edge 62–63 are fixed at one position." in result.summary()


@pytest.mark.slow
def test_a_vertex_without_a_position_is_named():
    """One inner vertex is joined to the whole surface of a body; of the bent body no point sees the whole surface."""
    from scipy.spatial import ConvexHull

    S = sphere_points(50)
    X = np.concatenate([S, [(0, 0, 0)]])
    T = np.column_stack([ConvexHull(S).simplices, np.full(96, 50)])
    for bend, success in ((0.1, True), (0.7, False)):
        Y = X * (0.3, 0.3, 1.5)
        Y[:, 0] += bend * Y[:, 2] ** 2
        result = injective_tetrahedra(X, T, range(50), Y[:50])
        assert not len(result.certificate.crossings)
        assert result.success == success
        assert (result.status is TetrahedraStatus.IMPOSSIBLE) == (not success)
    assert "Free vertex 50 has no position" in result.summary()


@pytest.mark.slow
def test_edges_that_meet_triangles_agree_with_rational_numbers():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(150):
        X = rng.integers(0, 4, (5, 3)).astype(float)
        corners = exact(X)
        if not any(cross(minus(corners[3], corners[2]), minus(corners[4], corners[2]))) or corners[0] == corners[1]:
            continue
        found = edges_meeting_triangles(np.array([[0, 1]]), np.array([[2, 3, 4]]), X)
        expected = bool(contact([corners[0], corners[1], corners[1]], corners[2:]))
        assert bool(len(found)) == expected, X
        hits += expected
    assert 25 < hits < 125


@pytest.mark.slow
def test_needles_and_malformed_meshes():
    X, T, cavity = shell(4)
    thin = X.copy()
    thin[:, 2] *= 1e-12
    assert morph(thin, T, cavity, thin[cavity] * (1.05, 1, 1)).valid
    flat = X.copy()
    flat[:, 2] = 0
    broken = X.copy()
    broken[T[0, 0]] = np.nan
    twice = X.copy()
    twice[T[0, 0]] = twice[T[0, 1]]
    folded = X.copy()
    inner = np.setdiff1d(np.arange(len(X)), np.unique(certify_tetrahedra(T, X).boundary))
    folded[inner[0]] += 0.9
    for points, cells, message in (
        (flat, T, "degenerate at rest"),
        (broken, T, "not finite"),
        (twice, T, "degenerate at rest"),
        (folded, T, "on the same side of a face"),
        (X, np.concatenate([T, T[:1]]), "repeated"),
        (X, np.empty((0, 4), dtype=int), "no tetrahedra"),
        (X, np.zeros((3, 10), dtype=int), "second-order tetrahedra are not supported"),
        (X, np.zeros((3, 8), dtype=int), "hexahedra are not supported"),
    ):
        with pytest.raises(ValueError, match=message):
            morph(points, cells, cavity, X[cavity])
    with pytest.raises(ValueError, match="not finite"):
        morph(X, T, cavity, np.full((len(cavity), 3), np.inf))
    with pytest.raises(ValueError, match="vertex 0 moved more than once"):
        morph(X, T, [0, 0], X[[0, 0]])
    for options, message in (({"energy": "foo"}, "foo"), ({"linear_solver": "foo"}, "linear_solver must be one of")):
        for function in (morph, lambda X, T, moved, _, **options: MovingMesh(X, T, moved, **options)):
            with pytest.raises(ValueError, match=message):
                function(X, T, cavity, X[cavity], **options)
    with pytest.raises(ValueError, match="callback"):
        morph(X, T, cavity, X[cavity], callback=3)


def test_quality():
    regular = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1.0)])
    row = np.array([[0, 1, 2, 3]])
    sign = tetrahedron_quality(row, regular)
    assert abs(sign[0]) == pytest.approx(1)
    assert tetrahedron_quality(row[:, [1, 0, 2, 3]], 1e100 * regular)[0] == pytest.approx(-sign[0])


@pytest.mark.slow
def test_mesh_objects_and_files(tmp_path):
    X, T, cavity = shell(4)
    there = turned(X[cavity], 10)
    expected = morph(X, T, cavity, there).points
    walls = certify_tetrahedra(T, X).boundary
    mesh = meshlane.Mesh(X, [("triangle", walls), ("tetra", T[:50]), ("tetra", T[50:])])
    np.testing.assert_array_equal(morph(mesh, cavity, there).points, expected)
    skfem = SimpleNamespace(doflocs=X.T, t=T.T, dofs=SimpleNamespace(element_dofs=T.T))
    np.testing.assert_array_equal(morph(skfem, cavity, there).points, expected)
    dolfinx = SimpleNamespace(geometry=SimpleNamespace(x=X, dofmap=T))
    np.testing.assert_array_equal(morph(dolfinx, cavity, there).points, expected)
    meshlane.write(tmp_path / "mesh.vtu", mesh)
    np.testing.assert_array_equal(morph(tmp_path / "mesh.vtu", cavity, there).points, expected)
    with pytest.raises(ValueError, match="'tetra10'"):
        morph(SimpleNamespace(points=X, cells_dict={"tetra10": np.zeros((1, 10), int)}), cavity, there)


@cache
def displaced():
    """A displacement of the cavity, and the positions of all vertices after it."""
    X, T, cavity = shell(4)
    displacement = np.zeros_like(X)
    displacement[cavity] = turned(X[cavity], 20) - X[cavity]
    points = morph(X, T, cavity, X[cavity] + displacement[cavity]).points
    for array in (displacement, points):
        array.setflags(write=False)
    return displacement, points


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".msh"])
def test_qhm_morph_keeps_everything_but_positions(suffix, tmp_path, capsys):
    X, T, _ = shell(4)
    displacement, points = displaced()
    form = {"file_format": "gmsh22"} if suffix == ".msh" else {}
    path, out = tmp_path / f"mesh{suffix}", tmp_path / f"moved{suffix}"
    walls = certify_tetrahedra(T, X).boundary
    marks = [np.arange(len(walls)) % 3, np.arange(len(T)) % 5]
    cell_data = {"gmsh:physical": marks, "gmsh:geometrical": marks} if suffix == ".msh" else {"mark": marks}
    mesh = meshlane.Mesh(X, [("triangle", walls), ("tetra", T)], point_data={"u": displacement}, cell_data=cell_data)
    meshlane.write(path, mesh, **form)
    assert main(["morph", str(path), "--field", "u", "-o", str(out)]) == 0
    assert "Injective" in capsys.readouterr().out
    moved = read_volume(out)
    np.testing.assert_array_equal(moved.points, points)
    np.testing.assert_array_equal(moved.F, T)
    # With the old positions every byte is the old one.
    assert moved.parts.replace_points(X) == path.read_bytes() or suffix == ".msh"
    assert main(["check", str(out)]) == 0


@pytest.mark.slow
def test_qhm_morph_reads_positions(tmp_path):
    X, T, cavity = shell(4)
    path, out = tmp_path / "mesh.vtu", tmp_path / "moved.vtu"
    meshlane.write(path, meshlane.Mesh(X, [("tetra", T)]))
    table = tmp_path / "positions.csv"
    table.write_text("".join(f"{v},{x},{y},{z}\n" for v, (x, y, z) in zip(cavity, X[cavity], strict=True)))
    assert main(["morph", str(path), "--positions", str(table), "-o", str(out)]) == 0
    assert main(["morph", str(path), "--positions", str(table), "--energy", "mips", "-o", str(out)]) == 2
