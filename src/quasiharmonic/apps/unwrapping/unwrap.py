"""Texture coordinates for any model in one call: `unwrap`."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import TypedDict, Unpack

from numpy.typing import ArrayLike

from quasiharmonic.apps.unwrapping.model_files import reads_hard_edges
from quasiharmonic.apps.unwrapping.result import UnwrapResult, UnwrapStep
from quasiharmonic.apps.unwrapping.scenes import accepts_scene
from quasiharmonic.apps.unwrapping.stages import collect, find_charts_in_time, place_and_certify, prepare
from quasiharmonic.io.accepts_mesh import accepts_mesh
from quasiharmonic.util.options import UnwrapOptions, takes
from quasiharmonic.util.progress import reports_progress


class UnwrapKeywords(TypedDict, total=False):
    """Types of the options of `unwrap`."""

    max_stretch: float
    max_charts: int | None
    resolution: int | tuple[int, int]
    padding: float
    texels_per_unit: float | None
    tiles: int
    tile_by: ArrayLike | str | None
    lightmap: bool
    rotate: bool
    stack: bool | str
    outward: bool
    weld: bool | float
    meshes: ArrayLike | None
    instances: str
    weights: Mapping[str, float] | Sequence[float] | None
    hard_edges: float | str | ArrayLike | None
    symmetry: str | None
    up: str | None
    packing_loss: float
    divide_for_packing: bool
    straighten: bool
    edge_costs: ArrayLike | None
    seams: ArrayLike | None
    no_seams: ArrayLike | None
    labels: ArrayLike | None
    uv: ArrayLike | None
    faces: ArrayLike | None
    seed: int
    time_limit: float | None
    callback: Callable[[UnwrapStep], object] | None
    jobs: int | None


# From the inside: options are checked, progress is shown for one model, meshes become arrays, the file of a mesh is
# asked for hard edges while it is one, and scenes are calls for their meshes together.
@accepts_scene
@reads_hard_edges
@accepts_mesh
@reports_progress
@takes(UnwrapOptions, UnwrapKeywords)
def unwrap(V: ArrayLike, F: ArrayLike, **options: Unpack[UnwrapKeywords]) -> UnwrapResult:
    """Compute texture coordinates for any model: charts with little stretch, packed into a texture, certified.

    Parameters
    ----------
    V : (n, 2) or (n, 3) array, or a mesh in place of ``V`` and ``F``
        Positions. A list of meshes or of pairs (V, F), or a scene of trimesh, is unwrapped into one texture, and the
        result is a `SceneResult`; transformations of the scene scale the texel density.
    F : (f, 3) array of int
        Any triangles. Degenerate and repeated triangles get the texture coordinates of a neighbour. Surfaces are cut at
        edges of three or more triangles and where they cannot be oriented; see `clean`.
    max_stretch : float
        Bound on the stretch max(σ₁, 1/σ₂) at 99 % of the surface, at least 1. No triangle may be stretched by more than
        3, except triangles with an angle below 1°. Lower values need more seams. `UnwrapResult.misses` lists the charts
        that exceed the bound.
    max_charts : int, optional
        Maximum number of charts. It is exceeded only by connected parts, by parts between seams that you demand, and by
        parts that have no bijective map otherwise.
    resolution : int or (int, int)
        Side of the texture in texels, or width and height.
    padding : float
        Minimum distance between two charts in texels.
    texels_per_unit : float, optional
        Texels per unit of length of the model. Default: the largest value at which all charts fit.
    tiles : int
        Number of tiles (UDIM). Tile k is the unit square whose lower left corner is ``(k % 10, k // 10)``. Charts too
        long for a tile are divided, so more tiles give more charts.
    tile_by : (f,) array of int or "material", optional
        The triangles with the same number get a tile of their own, in ascending order of the numbers, all tiles at one
        density. With ``"material"``, the numbers are those of the materials of a file, a `MeshData`, or of the meshes
        of trimesh in a list or a scene.
    lightmap : bool
        Whether the texture is a lightmap: boxes of charts begin at even texels, sides of rectangular charts lie between
        texels, which changes their length by at most half a texel, and no chart is shorter than two texels. Edges of
        more than 60° are seams, unless ``hard_edges`` is given. Instances have places of their own. The padding is at
        least four texels; then no bilinear filter mixes charts, at the resolution or at half of it.
        `UnwrapResult.stretch` and `UnwrapResult.misses` include the change of the lengths.
    rotate : bool
        Whether charts may be rotated to fit better.
    stack : bool or str
        Whether identical components share their texture coordinates; mirrored components, too. With ``"mirrored"``,
        only the mirror images of a symmetric model do; see ``symmetry``.
    outward : bool
        Whether closed components that are inside out are treated as turned outward. Their texture is then mirrored
        relative to the triangles of the input.
    weld : bool or float
        Whether vertices at equal positions count as one, or a distance relative to the diagonal of the bounding box
        within which they do; see `clean`. The result has the numbering of the input.
    meshes : (n,) array of int, optional
        Mesh of each vertex, if ``V`` and ``F`` are several meshes. Vertices of different meshes are not welded.
    instances : str
        For a mesh that occurs several times in the list, the scene or the glTF file: with ``"share"``, all occurrences
        share their texture coordinates, at the density of the largest; with ``"own"``, each occurrence has its own.
        With ``lightmap``, ``"own"`` applies. The vertices of a file are then those of
        ``io.read_gltf(path, instances="own")``.
    weights : sequence or mapping of float, optional
        Factors on the texel density: one for each mesh of a list, or by names of the meshes of a scene.
    hard_edges : float, (k, 2) array of int, or "file", optional
        All edges with a larger angle between the normals, in degrees, become seams, as baked normal maps need it; or
        the listed edges. For a `MeshData` or a file, ``"file"`` means the edges with split normals or, without normals,
        between smoothing groups. Edges in ``no_seams`` are left out.
    symmetry : str or None
        Axis normal to the plane of symmetry, ``"x"``, ``"y"`` or ``"z"``; ``"auto"`` takes the first one that fits.
        Seams and charts are mirrored if every vertex has a mirror image, to 1e-6 of the diagonal of the model's box,
        and every triangle. Curved parts are not mirrored if their triangles cross the plane, or if their seams would
        be much longer. `UnwrapResult.symmetry` says what was done. No effect if ``uv`` is given; ``"auto"`` also with
        ``edge_costs``, ``seams``, ``no_seams`` or ``labels``.
    up : str, optional
        Direction that points up: ``"x"``, ``"y"``, ``"z"``, ``"-x"``, ``"-y"`` or ``"-z"``. Seams then cost a tenth
        less where the surface faces down, and a tenth less in concave edges. By default visibility has no influence.
    packing_loss : float
        Flat and developable parts are joined across edges, for fewer charts and shorter seams, as long as the estimated
        share of the texture that they use falls by at most this value below the best one.
    divide_for_packing : bool
        Whether flat and developable parts are also divided where this saves texture. By default, they are divided only
        where they are longer than the texture's side.
    straighten : bool
        Whether strips become rectangles: curved parts that are regular grids of quadrilaterals, or tubes of these, each
        quadrilateral made of two triangles. A strip ends at edges of the surface, at creases or at demanded seams.
        A strip stays unchanged if a triangle of it would be stretched beyond the bound (`UnwrapResult.strips`).
    edge_costs : (f, 3) array, optional
        Positive factor on the cost of a seam at each side of each triangle, from corner 0 to 1, 1 to 2 and 2 to 0.
        Large values keep seams away from visible parts. Values of at least 1,000 keep two triangles together where
        possible, such as the triangles of a polygon.
    seams : (k, 2) array of int, optional
        Edges that become seams, by vertices, such as `UnwrapResult.seams`. Where they end inside a flat or developable
        part, they are extended to its border or to another seam. A single edge elsewhere is extended by one edge.
        Boundary edges have no effect.
    no_seams : (k, 2) array of int, optional
        Edges that must not become seams.
    labels : (f,) array of int, optional
        Part of the model to which each triangle belongs, such as a material. Seams between parts cost almost nothing,
        and charts are joined across them last.
    uv : (n, 2) or (f, 3, 2) array, optional
        Texture coordinates of each vertex, or of each corner, whose seams are kept. Further seams are made only in
        closed parts, in parts with handles, and where the bound requires it. By default all seams are new.
    faces : (k,) array of int or (f,) array of bool, optional
        Only these triangles are unwrapped. All others keep their texture coordinates ``uv``, which is required, bit for
        bit. New charts are placed into free space of the texture, by default at the mean texel density of the others.
        Edges between both become seams.
    seed : int
        Seed of random choices. Equal input and seed give equal results, unless the time limit ends the search.
    time_limit : float, optional
        Wall time in seconds after which the best charts so far are returned, with status ``TIME_LIMIT``. Where the
        search has no bijective charts within the bound yet, the charts are grown by normals: these are more, and
        `UnwrapResult.unfinished` lists them. Cleaning, packing and verification always run to their end.
    callback : callable, optional
        Called with an `UnwrapStep`, at least every half second. Exceptions propagate.
    jobs : int, optional
        Number of threads for models of 200,000 triangles or more; smaller models use one. Default: all cores. The
        result does not depend on it.

    Returns
    -------
    UnwrapResult
        Iterates as ``vmapping, indices, uvs``, the arrays of ``xatlas.parametrize``. All charts are bijective. If the
        bound is not kept, the result lists the charts (`UnwrapResult.misses`).

    Raises
    ------
    ValueError
        If an array has the wrong shape, a position is not finite, an index is out of range, or no triangle has an area.
        The message names the elements. Also if pairs in ``seams`` or ``no_seams`` are no edges of the mesh, are in both
        lists, or cannot be kept. If the texture is too small for all charts and their padding, the message states a
        resolution that suffices for these charts, or with ``faces`` a sufficient texel density. With another resolution
        the charts can differ.

    See Also
    --------
    flatten : One surface with a boundary, without a texture.
    bake : The look of the model for the new texture coordinates.
    clean : The surfaces that a model with defects forms.
    quasiharmonic.atlas.pack_charts : Places charts that exist.

    Examples
    --------
    >>> from quasiharmonic.surfaces import starfish
    >>> V, F = starfish(3, 12)
    >>> result = unwrap(V, F)
    >>> vmapping, indices, uvs = result
    >>> bool((V[vmapping][indices] == V[F]).all()), result.certificate.bijective
    (True, True)
    """
    began = time.perf_counter()
    task = prepare(V, F, UnwrapOptions(**options))
    found = find_charts_in_time(task, began)
    return collect(task, found, place_and_certify(task, found), began)
