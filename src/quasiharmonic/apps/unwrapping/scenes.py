"""Several meshes in one texture: `unwrap` of a list of meshes, or of a scene of trimesh."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from os import PathLike
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike

from quasiharmonic.apps.inverse_map import ChartInverse
from quasiharmonic.apps.unwrapping.cleaning import turn_corners
from quasiharmonic.apps.unwrapping.model_files import label_statements
from quasiharmonic.apps.unwrapping.result import UnwrapResult
from quasiharmonic.io.accepts_mesh import AcceptsMesh
from quasiharmonic.io.formats.gltf.reader import compare_size
from quasiharmonic.io.mesh_files import read_model, separates_instances
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.objects import MeshLike, make_trimesh, mesh_arrays, stands_for_mesh
from quasiharmonic.util.arrays import (
    FloatArray,
    IntArray,
    check_choice,
    check_positive,
    count_of,
    describe,
    pad_to_space,
    repeat_each,
    triangle_array,
    vertex_array,
)
from quasiharmonic.util.options import INSTANCES
from quasiharmonic.util.outcome import OutcomeOf

if TYPE_CHECKING:
    from trimesh import Scene, Trimesh

P = ParamSpec("P")


class SceneLike(Protocol):
    """A scene of trimesh: meshes by name, and a graph that places them."""

    @property
    def geometry(self) -> Any: ...
    @property
    def graph(self) -> Any: ...


@dataclass(frozen=True, eq=False)
class ScenePart:
    """Texture coordinates of one mesh of a scene; iterates as ``vmapping, indices, uvs``.

    Attributes
    ----------
    name : str
        Name of the mesh in the scene, or its position in the list.
    node : str or None
        The node of the scene that has the mesh at this place, with ``instances="own"``; None if all nodes share it.
    V : (n, 2) or (n, 3) float64
        Positions of the mesh, without the transformation in the scene.
    vmapping, indices, uvs, charts
        As those of `UnwrapResult`, for this mesh.
    texels_per_unit : float
        Texels per unit of length of the mesh, without the transformation. If that stretches the mesh, the geometric
        mean over its directions.
    source : object
        The mesh that was given.
    excluded : (k,) int64
        Triangles without area, and repeated ones; they have the texture coordinates of others.
    """

    name: str
    node: str | None
    V: FloatArray
    vmapping: IntArray
    indices: IntArray
    uvs: FloatArray
    charts: IntArray
    texels_per_unit: float
    source: Any
    excluded: IntArray

    def __iter__(self) -> Iterator[Any]:
        return iter((self.vmapping, self.indices, self.uvs))

    def inverse(self) -> ChartInverse:
        """Return the inverse map, from the texture to the mesh; see `UnwrapResult.inverse`."""
        return ChartInverse(self.V, self.vmapping[self.indices], self.uvs, self.indices, leave_out=self.excluded)

    def to_trimesh(self) -> Trimesh:
        """Return the mesh as a trimesh.Trimesh with texture coordinates; vertices are split at seams.

        Colours and attributes of vertices, attributes of faces, material and metadata of a trimesh.Trimesh are kept.
        """
        return make_trimesh(self.V[self.vmapping], self.indices, self.uvs, like=self.source, rows=self.vmapping)


@dataclass(frozen=True, eq=False, repr=False)
class SceneResult(OutcomeOf):
    """Texture coordinates of several meshes in one texture, made by `unwrap`.

    Attributes
    ----------
    parts : tuple of ScenePart
        One for each mesh, in the order of the list or of the scene; with ``instances="own"``, one for each node.
    atlas : UnwrapResult
        All meshes as one, transformed and weighted: vertices and triangles of one mesh after those of another.
        Triangles of mirrored nodes are reversed.
    source : object
        The list or the scene that was given.
    """

    parts: tuple[ScenePart, ...]
    atlas: UnwrapResult
    source: Any

    @property
    def result(self) -> UnwrapResult:
        """Equal to ``atlas``."""
        return self.atlas

    def summary(self) -> str:
        """Return the number of meshes, and the summary of the atlas."""
        return f"{count_of('mesh', 'meshes', len(self.parts))}\n{self.atlas.summary()}"

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON, without the arrays."""
        parts = [
            {"name": part.name, "charts": len(np.unique(part.charts)), "texels_per_unit": part.texels_per_unit}
            for part in self.parts
        ]
        return {**self.atlas.to_dict(), "parts": parts}

    def to_scene(self) -> Scene:
        """Return a copy of the scene of trimesh whose meshes have their texture coordinates.

        ValueError if the meshes came from a list.
        """
        if not _is_scene(self.source):
            raise ValueError("the meshes came from a list, not from a scene: use to_trimesh() of each part")
        scene: Scene = self.source.copy()
        for part in self.parts:
            if part.node is None:
                scene.geometry[part.name] = part.to_trimesh()
            else:
                scene.geometry.pop(part.name, None)
                name = f"{part.name} {part.node}"
                while name in scene.geometry:
                    name += "'"
                scene.geometry[name] = part.to_trimesh()
                scene.graph.transforms.node_data[part.node]["geometry"] = name
        return scene


@dataclass(frozen=True, eq=False)
class _Placed:
    """A mesh to unwrap, and the 3 × 3 matrix and shift of its place; positions are multiplied by the weight, too."""

    name: str
    node: str | None
    source: Any
    matrix: FloatArray
    shift: FloatArray
    weight: float

    @property
    def scale(self) -> float:
        """Factor on lengths, the geometric mean over all directions."""
        return float(self.weight * np.abs(np.linalg.det(self.matrix)) ** (1 / 3))

    @property
    def is_mirrored(self) -> bool:
        """Whether the transformation is a reflection, which reverses triangles."""
        return bool(np.linalg.det(self.matrix) < 0)


class AcceptsScene(Protocol[P]):
    """`unwrap`: a function of ``V``, ``F`` and options, of a mesh and options, or of several meshes and options."""

    @overload
    def __call__(self, V: ArrayLike, F: ArrayLike, *args: P.args, **kwargs: P.kwargs) -> UnwrapResult: ...
    @overload
    def __call__(  # type: ignore[overload-overlap]
        self, scene: list[Any] | SceneLike, /, *args: P.args, **kwargs: P.kwargs
    ) -> SceneResult: ...
    @overload
    def __call__(self, mesh: MeshLike, /, *args: P.args, **kwargs: P.kwargs) -> UnwrapResult: ...


def accepts_scene(function: AcceptsMesh[P, UnwrapResult]) -> AcceptsScene[P]:
    """Decorate `unwrap` so that it accepts a list of meshes, or a scene of trimesh, in place of ``V`` and ``F``.

    The meshes of one file are distinguished, and a mesh of trimesh is kept for `UnwrapResult.to_trimesh`.
    """
    called: Callable[..., Any] = function

    @wraps(called)
    def call(*args: Any, **options: Any) -> Any:
        if isinstance(options.get("tile_by"), str):
            check_choice("tile_by", options["tile_by"], ("material",))
        given = args[0] if len(args) == 1 else options.pop("V", None) if not args and "F" not in options else None
        if given is None or "F" in options:
            return called(*args, **options)
        if isinstance(given, str | PathLike):
            separated, given = separates_instances(given, options), read_model(given, options)
            if separated:
                options.pop("instances", None)
        if _is_scene(given) or _is_list_of_meshes(given):
            return _unwrap_scene(called, given, **options)
        if isinstance(given, MeshData) and given.carried is not None and given.carried.fits(given):
            options = {"meshes": given.carried.number_meshes(), **options}
        if isinstance(options.get("tile_by"), str) and (isinstance(given, MeshData) or hasattr(given, "visual")):
            options = {**options, "tile_by": _number_materials([given], [len(mesh_arrays(given)[1])])}
        result = called(given, **options)
        return replace(result, source=given) if hasattr(given, "vertex_attributes") else result

    return call


def _is_scene(value: object) -> bool:
    return hasattr(value, "geometry") and hasattr(value, "graph")


def _is_list_of_meshes(value: object) -> bool:
    """Whether a value is a list of meshes, or of pairs (V, F), and not a list of positions."""
    if not isinstance(value, list):
        return False
    return all(stands_for_mesh(one) or (isinstance(one, tuple) and np.ndim(one[:1]) > 2) for one in value)


def _unwrap_scene(
    unwrap: Callable[..., UnwrapResult],
    scene: Any,
    *,
    instances: str = "share",
    weights: Mapping[str, float] | Sequence[float] | None = None,
    **options: Any,
) -> SceneResult:
    """Unwrap several meshes into one texture."""
    check_choice("instances", instances, INSTANCES)
    if not _is_scene(scene) and not scene:
        raise ValueError("the list has no meshes: pass at least one")
    if weights is not None and not isinstance(weights, Mapping if _is_scene(scene) else Sequence | np.ndarray):
        kind = "a mapping from names of meshes to numbers" if _is_scene(scene) else "a sequence with a number per mesh"
        raise ValueError(f"weights must be {kind}, not {describe(weights)}")
    instances = "own" if options.get("lightmap") else instances
    placed, of_part = (
        _place_scene(scene, instances, weights) if _is_scene(scene) else _place_list(scene, instances, weights)
    )
    meshes = [_read(one) for one in placed]
    points = [
        (pad_to_space(V) @ one.matrix.T + one.shift) * one.weight for one, (V, _) in zip(placed, meshes, strict=True)
    ]
    vertices, triangles = [len(V) for V, _ in meshes], [len(F) for _, F in meshes]
    if isinstance(options.get("tile_by"), str):
        options["tile_by"] = _number_materials([one.source for one in placed], triangles)
    first, begin = np.cumsum([0, *vertices]), np.cumsum([0, *triangles])
    turned = repeat_each([one.is_mirrored for one in placed], triangles)
    if np.shape(options.get("uv", ())) == (*turned.shape, 3, 2):
        options["uv"] = turn_corners(np.asarray(options["uv"]), turned)
    corners = np.concatenate([F + start for (_, F), start in zip(meshes, first, strict=False)])
    atlas = unwrap(
        np.concatenate(points),
        turn_corners(corners, turned),
        meshes=repeat_each(np.arange(len(placed)), vertices),
        **options,
    )
    parts, rows_in_atlas = [], turn_corners(atlas.indices, turned)
    for k, (one, (V, F)) in enumerate(zip(placed, meshes, strict=True)):
        faces = slice(begin[k], begin[k] + len(F))
        rows, indices = np.unique(rows_in_atlas[faces], return_inverse=True)
        excluded = atlas.cleaned.excluded
        parts.append(
            ScenePart(
                name=one.name,
                node=one.node,
                V=V,
                vmapping=atlas.vmapping[rows] - first[k],
                indices=indices.reshape(-1, 3),
                uvs=atlas.uvs[rows],
                charts=atlas.charts[faces],
                texels_per_unit=atlas.texels_per_unit * one.scale,
                source=one.source,
                excluded=excluded[(excluded >= begin[k]) & (excluded < begin[k + 1])] - begin[k],
            )
        )
    named = [replace(parts[k], name=name) for name, k in of_part]
    return SceneResult(tuple(named), atlas, scene)


def _number_materials(sources: Sequence[Any], triangles: Sequence[int]) -> IntArray:
    """Return the number of the material (f,) of each triangle of several meshes; equal materials of one name are one.

    ValueError if there are none. Materials of files with one name are equal.
    """
    known, numbers = dict[object, int](), []
    for source, count in zip(sources, triangles, strict=True):
        if isinstance(source, MeshData):
            label, names = label_statements(source, "usemtl")
            keys: list[object] = [b"", *names]
        else:
            material = getattr(getattr(source, "visual", None), "material", None)
            # Materials of trimesh with equal contents have equal hashes; many have the same name.
            own = (getattr(material, "name", None), hash(material))
            label, keys = np.zeros(count, dtype=np.int64), [b"" if material is None else own]
        numbers.append(np.array([known.setdefault(key, len(known)) for key in keys])[label])
    if set(known) <= {b""}:
        raise ValueError("tile_by='material', but there are no materials: omit tile_by, or give numbers")
    return np.concatenate(numbers)


def _place_list(scene: list[Any], instances: str, weights: Any) -> tuple[list[_Placed], list[tuple[str, int]]]:
    """Return the meshes of a list to unwrap, and for each part its name and its mesh."""
    if weights is not None and len(weights) != len(scene):
        raise ValueError(
            f"weights must have {count_of('number', 'numbers', len(scene))}, one per mesh, not {len(weights)}"
        )
    placed, of_part, known = list[_Placed](), list[tuple[str, int]](), dict[tuple[int, float], int]()
    for k, mesh in enumerate(scene):
        weight = 1.0 if weights is None else weights[k]
        key = (id(mesh), float(weight)) if instances == "share" else (-k - 1, 0.0)
        if key not in known:
            known[key] = len(placed)
            placed.append(_Placed(str(k), None, mesh, np.eye(3), np.zeros(3), weight))
        of_part.append((str(k), known[key]))
    return placed, of_part


def _place_scene(scene: Any, instances: str, weights: Any) -> tuple[list[_Placed], list[tuple[str, int]]]:
    """Return the meshes of a scene to unwrap, and for each part its name and its mesh."""
    weights = {} if weights is None else dict(weights)
    if unknown := sorted(set(weights) - set(scene.geometry)):
        raise ValueError(f"weights names {unknown[0]!r}, which is no mesh of the scene: {', '.join(scene.geometry)}")
    nodes = {name: list[str | None]() for name in scene.geometry}
    for node in scene.graph.nodes_geometry:
        nodes[scene.graph[node][1]].append(node)
    placed = list[_Placed]()
    for name, mesh in scene.geometry.items():
        if not hasattr(mesh, "faces"):
            continue  # points and curves have no texture coordinates
        here = []
        for node in nodes[name] or [None]:
            matrix = np.eye(4) if node is None else np.asarray(scene.graph[node][0], dtype=np.float64)
            if not np.isfinite(matrix).all() or not np.linalg.det(matrix[:3, :3]):
                raise ValueError(f"the transformation of node {node!r} has no inverse: remove the node")
            own = node if instances == "own" and len(nodes[name]) > 1 else None
            here.append(_Placed(name, own, mesh, matrix[:3, :3], matrix[:3, 3], weights.get(name, 1.0)))
        # Nodes that share texture coordinates have the density of the largest.
        placed += here if instances == "own" else [max(here, key=lambda one: compare_size(one.matrix))]
    if not placed:
        raise ValueError("the scene has no meshes: add one with triangles")
    return placed, [(one.name, k) for k, one in enumerate(placed)]


def _read(one: _Placed) -> tuple[FloatArray, IntArray]:
    """Return positions (n, 2) or (n, 3) and triangles (f, 3) of a mesh; errors name the mesh."""
    try:
        check_positive(weights=one.weight)
        V, F = mesh_arrays(one.source) if stands_for_mesh(one.source) else one.source
        V = vertex_array(V)
        return V, triangle_array(F, len(V))
    except ValueError as error:
        raise ValueError(f"mesh {one.name}: {error}") from error
