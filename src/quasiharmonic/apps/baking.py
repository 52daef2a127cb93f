"""Bake the look of a model into textures for new texture coordinates: `bake`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from quasiharmonic.apps.model_look import (
    Bytes,
    SurfaceLook,
    TangentFrames,
    encode,
    find_sources,
    tangent_frames,
    to_bytes,
)
from quasiharmonic.apps.unwrapping.model_files import add_map
from quasiharmonic.apps.unwrapping.result import UnwrapResult
from quasiharmonic.geometry.mesh.point_queries import NearestPoint, Raster
from quasiharmonic.io.formats.gltf.reader import CarriedGltf
from quasiharmonic.io.looks import read_appearance
from quasiharmonic.io.mesh_files import read_mesh
from quasiharmonic.io.models.meshdata import MeshData
from quasiharmonic.io.models.textures import MaterialTextures
from quasiharmonic.util.arrays import BoolArray, FloatArray, IntArray, count_of, describe
from quasiharmonic.util.options import BakeOptions, takes
from quasiharmonic.util.outcome import BaseOutcome, as_plain

#: Colour of texels that are too far from the old model, 8-bit sRGB.
MISSING = (255, 0, 255)


class BakeTuning(NamedTuple):
    """Numbers that tune the transfer of texels."""

    # Samples per block of rows.
    block: int = 1 << 17
    # Two meshes are the same if their corners are this close, relative to the size.
    same: float = 1e-6
    # Triangles whose area is below this share of the square of their longest side are degenerate.
    thin: float = 1e-12


_TUNING = BakeTuning()


MeshOrPath = MeshData | str | os.PathLike[str]


class BakeKeywords(TypedDict, total=False):
    """Types of the options of `bake`."""

    size: int | tuple[int, int]
    samples: int
    padding: int
    max_distance: float
    jpeg: bool


@dataclass(frozen=True, eq=False, repr=False)
class BakeResult(BaseOutcome):
    """Textures made by `bake`.

    Attributes
    ----------
    mesh : MeshData
        The new model with its textures, for `quasiharmonic.io.write_mapped`.
    colour : (h, w, 4) uint8
        Base colour, sRGB, with opacity; first row on top, where v is 1.
    metallic_roughness : (h, w, 3) uint8 or None
        Occlusion, roughness and metallic values. None if they are the same everywhere: `mesh.texture` has them.
    normal : (h, w, 3) uint8 or None
        Normals in the tangent space of the new texture coordinates. None if the old model has no normal maps.
    emission : (h, w, 3) uint8 or None
        Emitted light, sRGB. None if it is the same everywhere.
    covered : int
        Number of texels whose centre, or one of whose samples, is in a triangle.
    missing : int
        Number of covered texels that are too far from the old model. They have the colour `MISSING`, magenta.
    same_mesh : bool
        Whether both models have the same triangles, so that points correspond exactly.
    problems : tuple of str
        Textures that could not be used, with the reason, and other parts of the look that are not baked.
    seconds : float
        Wall time of the call.

    See Also
    --------
    bake : Makes it.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import bake, io, unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 4)
    >>> old = io.MeshData(V, F, extra=np.tile([0.0, 0.0, 1.0], (len(V), 1)))
    >>> result = bake(old, unwrap(V, F), size=64)
    >>> result.success, result.colour.shape, result.problems
    (True, (64, 64, 4), ())
    """

    mesh: MeshData
    colour: Bytes
    metallic_roughness: Bytes | None
    normal: Bytes | None
    emission: Bytes | None
    covered: int
    missing: int
    same_mesh: bool
    problems: tuple[str, ...]
    seconds: float

    @property
    def success(self) -> bool:
        """Whether the whole look of the old model was baked."""
        return not self.missing and not self.problems

    @property
    def message(self) -> str:
        """The outcome in a sentence, and what to do if it is not a success."""
        height, width = self.colour.shape[:2]
        maps = {"metallic-roughness": self.metallic_roughness, "normal": self.normal, "emission": self.emission}
        names = ", ".join(["base colour", *(name for name, image in maps.items() if image is not None)])
        how = "the same triangles" if self.same_mesh else "the nearest points"
        text = f"Baked {names} at {width} x {height} by {how}; {self.covered} texels are covered."
        if self.missing:
            text += (
                f" {count_of('texel is', 'texels are', self.missing)} too far from the old model, and magenta: "
                "raise max_distance, or check that both models are in the same place."
            )
        if self.problems:
            text += f" {count_of('problem', 'problems', len(self.problems))}: correct the models as listed."
        return text

    def summary(self) -> str:
        """Return the outcome, and the problems, a line each."""
        return "\n".join([self.message, *self.problems])

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON, without the images."""
        height, width = self.colour.shape[:2]
        return {
            **as_plain(self, "success", "message"),
            "size": [width, height],
            **{name: getattr(self, name) is not None for name in ("metallic_roughness", "normal", "emission")},
            **as_plain(self, "covered", "missing", "same_mesh"),
            "problems": list(self.problems),
            "seconds": self.seconds,
        }


@takes(BakeOptions, BakeKeywords)
def bake(old: MeshOrPath, new: MeshOrPath | UnwrapResult, **options: Unpack[BakeKeywords]) -> BakeResult:
    """Bake the look of a model into textures for new texture coordinates.

    Base colours contain the factors of the materials, opacity, and the colours of vertices. Metallic-roughness values
    with occlusion, normal maps and emitted light are baked if the old model has any. Colours are filtered as linear
    light, bilinearly. A texel has the value at its centre.

    Parameters
    ----------
    old : MeshData or path
        The model as it was read, with its materials and colours: GLB, glTF, OBJ with its .mtl, or PLY with colours.
        Without texture coordinates, it has the factors of its materials and the colours of its vertices.
    new : MeshData, path or UnwrapResult
        A model with texture coordinates in the unit square, at the same place. If it has the same triangles as the old
        model in the same order, points correspond exactly. Otherwise each point gets the look of the nearest point of
        the old model. For the result of `quasiharmonic.unwrap` of the old model, all other data of it are kept.
    size : int or (int, int)
        Side of the textures in texels, or width and height, at most 8192.
    samples : int
        Samples along each side of a texel; it gets their mean. More than one smooths images that are finer than the
        texels.
    padding : int
        Number of texels beside charts that get the values of the nearest texel of a chart. Others have the mean.
    max_distance : float
        Texels farther from the old model are missing, relative to the diagonal of the bounding box of the new one.
    jpeg : bool
        Make JPEG images of quality 95 of colours without opacity, and of emitted light; others are PNG.

    Returns
    -------
    BakeResult
        Its ``mesh`` has the textures; write it with `quasiharmonic.io.write_mapped`. Textures that are missing or
        damaged are listed as problems, and baked as their factors.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, the new model has no texture coordinates in the unit square, or a model has no
        triangles.
    quasiharmonic.io.MeshFileError
        If a file cannot be read.

    See Also
    --------
    unwrap : Makes texture coordinates.
    quasiharmonic.io.write_mapped : Writes the model with its textures.

    Examples
    --------
    >>> import numpy as np
    >>> from quasiharmonic import bake, io, unwrap
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 12)
    >>> old = io.MeshData(V, F, extra=np.tile([1.0, 0.6, 0.0], (len(V), 1)))
    >>> result = bake(old, unwrap(V, F), size=256)
    >>> result.same_mesh, result.missing, result.colour[128, 128].tolist()
    (True, 0, [255, 153, 0, 255])
    """
    began = time.perf_counter()
    wanted = BakeOptions(**options)
    before = _as_mesh("old", old)
    after = _map_of(new, before) if isinstance(new, UnwrapResult) else _as_mesh("new", new)
    if not len(before.F) or not len(after.F):
        raise ValueError("a model without triangles has no look to bake")
    size = tuple(wanted.size) if isinstance(wanted.size, tuple | list) else (wanted.size, wanted.size)
    work = _Baker(before, after, size, wanted)
    return work.result(work.bake(), began)


def _as_mesh(name: str, mesh: object) -> MeshData:
    if isinstance(mesh, str | os.PathLike):
        return read_mesh(mesh)
    if not isinstance(mesh, MeshData):
        raise TypeError(f"{name} must be a MeshData or the path of a file, not {describe(mesh)}")
    if mesh.extra is not None and len(mesh.extra) != len(mesh.V):
        raise ValueError(f"{name} has extra data for {len(mesh.extra)} vertices, but {len(mesh.V)} vertices")
    return mesh


def _map_of(result: UnwrapResult, old: MeshData) -> MeshData:
    """Return the mesh of a result of `unwrap`; the old mesh with its map, if it has the same triangles."""
    made = MeshData(result.V, result.vmapping[result.indices], vt=result.uvs, FT=result.indices)
    return add_map(old, result)[0] if np.array_equal(made.F, old.F) and np.array_equal(made.V, old.V) else made


class _Baker:
    """The work of one call: the rows of the new texture, block by block."""

    def __init__(self, old: MeshData, new: MeshData, size: tuple[int, int], wanted: BakeOptions) -> None:
        self._new, self._wanted = new, wanted
        self._width, self._height = size
        self._look = SurfaceLook(read_appearance(old))
        self.problems = self._look.problems
        self._corners = new.V[new.F]
        diagonal = float(np.linalg.norm(np.ptp(self._corners.reshape(-1, 3), axis=0)))
        self._reach = wanted.max_distance * diagonal
        self._same = len(old.F) == len(new.F) and bool(
            (np.abs(old.V[old.F] - self._corners) <= _TUNING.same * diagonal).all()
        )
        self._nearest = None if self._same else NearestPoint(old.V, old.F)
        uv = new.corner_uv
        self._raster = self._make_raster(uv)
        self._frames: tuple[TangentFrames, TangentFrames] | None = None
        if self._look.has("normal"):
            coordinates = self._look.normal_coordinates() * [1, -1] + [0, 1]
            self._frames = tangent_frames(old, coordinates), tangent_frames(new, uv)
        materials = self._look.materials
        self._strength = max([1.0, *(value for material in materials for value in material.emission)])

    def _make_raster(self, uv: FloatArray) -> Raster:
        """Return the raster of the new texture coordinates (f, 3, 2), in samples."""
        bare = np.isnan(uv).any(axis=(1, 2))
        if bare.all():
            raise ValueError("the new model has no texture coordinates: unwrap it first")
        low, high = np.nanmin(uv, axis=1, initial=np.inf), np.nanmax(uv, axis=1, initial=-np.inf)
        if (((high <= 0) | (low >= 1)).any(axis=1) | bare).all():
            raise ValueError(
                "the new model has no texture coordinates in the unit square: move them there, or unwrap it again"
            )
        # No centre of a texel is farther outside than half a texel.
        margin = 0.5 / np.array([self._width, self._height])
        outside = ((low < -margin) | (high > 1 + margin)).any(axis=1) & ~bare
        if outside.any():
            count = count_of("triangle reaches", "triangles reach", int(outside.sum()))
            self.problems.append(
                f"{count} beyond the unit square of the new texture coordinates, where nothing is baked"
            )
        a, b, c = self._corners.swapaxes(0, 1)
        longest = np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
        degenerate = np.linalg.norm(np.cross(b - a, c - a), axis=1) <= _TUNING.thin * longest
        samples = self._wanted.samples
        scale = np.array([self._width, -self._height]) * samples
        placed = np.nan_to_num(uv * scale + [0, self._height * samples])
        return Raster(placed, self._width * samples, self._height * samples, degenerate | bare)

    def bake(self) -> dict[str, Bytes]:
        """Return the images by name, and what is covered, as ``covered``."""
        makers = self._makers()
        images = {
            name: np.zeros((self._height, self._width, channels), np.uint8) for name, (channels, *_) in makers.items()
        }
        covered = np.zeros((self._height, self._width), dtype=np.bool_)
        self.missing = 0
        for rows, texel, triangle, barycentric in self._blocks():
            here = np.s_[rows.start * self._width : rows.stop * self._width]
            which, mean = self._gather(texel, (rows.stop - rows.start) * self._width)
            covered.reshape(-1)[here][which] = True
            source, weights, far = self._match(triangle, barycentric)
            lost = mean(far.astype(np.float64)[:, None])[:, 0] > 0.5
            self.missing += int(lost.sum())
            for name, (_, srgb, default, evaluate) in makers.items():
                values = to_bytes(mean(evaluate(source, weights, triangle, barycentric)), srgb=srgb)
                values[lost] = default
                images[name].reshape(-1, values.shape[1])[here][which] = values
        self._fill(images, covered)
        self.covered = int(covered.sum())
        return images

    def _makers(self) -> dict[str, tuple[int, bool, tuple[int, ...], Callable[..., FloatArray]]]:
        """Return for each image its channels, whether it is sRGB, values of missing texels, and the function."""
        look, materials = self._look, self._look.materials
        makers: dict[str, tuple[int, bool, tuple[int, ...], Callable[..., FloatArray]]] = {
            "colour": (4, True, (*MISSING, 255), lambda t, b, *_: look.colours(t, b))
        }
        if look.has("metallic_roughness", "occlusion") or len({(m.metallic, m.roughness) for m in materials}) > 1:
            makers["metallic_roughness"] = 3, False, (255, 255, 0), lambda t, b, *_: look.metallic_roughness(t, b)
        if look.has("emission") or len({m.emission for m in materials}) > 1:
            makers["emission"] = 3, True, (0, 0, 0), lambda t, b, *_: look.emission(t, b) / self._strength
        if self._frames is not None:
            makers["normal"] = 3, False, (128, 128, 255), self._local_normals
        return makers

    def _blocks(self) -> Iterator[tuple[slice, IntArray, IntArray, FloatArray]]:
        """Yield blocks of rows, with the texels, triangles and barycentric coordinates of the samples in triangles."""
        samples = self._wanted.samples
        step = max(1, _TUNING.block // (self._width * samples**2))
        for begin in range(0, self._height, step):
            rows = slice(begin, min(begin + step, self._height))
            sample, triangle, barycentric = self._raster.rows(rows.start * samples, rows.stop * samples)
            if samples > 1:
                row, column = np.divmod(sample, self._width * samples)
                sample = row // samples * self._width + column // samples
            if sample.size:
                yield rows, sample, triangle, barycentric

    def _gather(self, texel: IntArray, count: int) -> tuple[IntArray, Callable[[FloatArray], FloatArray]]:
        """Return the texels of samples, each once, and a function that returns the mean (t, c) of values (k, c)."""
        if self._wanted.samples == 1:
            return texel, lambda values: values
        total = np.bincount(texel, minlength=count)
        which = np.flatnonzero(total)

        def mean(values: FloatArray) -> FloatArray:
            sums = [np.bincount(texel, one, count)[which] for one in values.T]
            return np.stack(sums, axis=1) / total[which, None]

        return which, mean

    def _match(self, triangle: IntArray, barycentric: FloatArray) -> tuple[IntArray, FloatArray, BoolArray]:
        """Return triangles and barycentric coordinates on the old model, and which points are too far from it."""
        if self._nearest is None:
            return triangle, barycentric, np.zeros(len(triangle), dtype=np.bool_)
        points = np.einsum("kc,kcd->kd", barycentric, self._corners[triangle])
        source, weights, distance = self._nearest.find(points)
        return source, weights, distance > self._reach

    def _local_normals(
        self, source: IntArray, weights: FloatArray, triangle: IntArray, barycentric: FloatArray
    ) -> FloatArray:
        """Return normals (k, 3) in the tangent space of the new texture coordinates, from 0 to 1."""
        assert self._frames is not None
        old, new = self._frames
        normal = self._look.normals(source, weights, old)
        tangent, bitangent, up = new.at(triangle, barycentric).swapaxes(0, 1)
        axes = np.cross(bitangent, up), np.cross(up, tangent), np.cross(tangent, bitangent)
        local = np.stack([(normal * axis).sum(axis=1) for axis in axes], axis=1)
        local *= np.sign((tangent * axes[0]).sum(axis=1))[:, None]
        length = np.linalg.norm(local, axis=1, keepdims=True)
        return 0.5 + 0.5 * np.divide(local, length, out=np.tile([0.0, 0.0, 1.0], (len(local), 1)), where=length > 0)

    def _fill(self, images: dict[str, Bytes], covered: BoolArray) -> None:
        """Fill the texels beside charts, and the rest with the mean."""
        if not covered.any():
            return
        texel, source = find_sources(covered, self._wanted.padding)
        for image in images.values():
            flat = image.reshape(-1, image.shape[2])
            mean = np.rint(image[covered].mean(axis=0)).astype(np.uint8)
            beside = flat[source]
            flat[~covered.ravel()] = mean
            flat[texel] = beside

    def result(self, images: dict[str, Bytes], began: float) -> BakeResult:
        """Return the result of a call that has ``began`` at a reading of the clock."""
        materials, jpeg = self._look.materials, self._wanted.jpeg
        colour, rough = images["colour"], images.get("metallic_roughness")
        normal, emission = images.get("normal"), images.get("emission")
        opaque = bool((colour[:, :, 3] == 255).all())
        shown = encode(colour[:, :, :3] if opaque else colour, jpeg=jpeg and opaque)
        strength = (self._strength,) * 3 if emission is not None else materials[0].emission
        modes = {material.alpha_mode for material in materials}
        keeps = self._same and isinstance(self._new.carried, CarriedGltf)
        texture = MaterialTextures(
            shown.data,
            shown.media_type,
            shown.suffix,
            metallic_roughness=None if rough is None else encode(rough, jpeg=False),
            normal=None if normal is None else encode(normal, jpeg=False),
            emission=None if emission is None else encode(emission, jpeg=jpeg),
            occlusion=self._look.has("occlusion"),
            metallic=materials[0].metallic if rough is None else 1.0,
            roughness=materials[0].roughness if rough is None else 1.0,
            emission_factor=strength,
            alpha_mode=None if keeps else next((mode for mode in ("BLEND", "MASK") if mode in modes), "OPAQUE"),
            alpha_cutoff=max(material.alpha_cutoff for material in materials),
            double_sided=any(material.double_sided for material in materials),
        )
        mesh, maps = replace(self._new, texture=texture), (colour, rough, normal, emission)
        seconds = time.perf_counter() - began
        return BakeResult(mesh, *maps, self.covered, self.missing, self._same, tuple(self.problems), seconds)
