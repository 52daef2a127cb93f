"""The steps that change a map. Each calls the library as the command does, and returns that command and a script.

A step depends on the model, on its options and, if it starts from a map, on that map, which the page saves as
`recipes.START`. The functions ``require_…`` check what a step needs before it starts.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from quasiharmonic.apps.atlas import island_functions as atlas
from quasiharmonic.apps.atlas.atlas_verdict import MIRROR, mirrored_islands
from quasiharmonic.apps.atlas.mapped_atlas import MappedAtlas, MappedIsland
from quasiharmonic.apps.atlas.seam_cuts import cut_along, cut_apart
from quasiharmonic.apps.uv_repair import repair
from quasiharmonic.energies.polishing import SMOOTHING_STEPS, is_smoothable
from quasiharmonic.geometry.curves import BoundaryCurves
from quasiharmonic.geometry.exact.certificate import certify
from quasiharmonic.geometry.mesh.topology import boundary_edges, edges, trace_loops
from quasiharmonic.io import MeshData, read_mesh
from quasiharmonic.io.objects import as_seamed_mesh
from quasiharmonic.io.seamed_mesh import Island, SeamedMesh
from quasiharmonic.problem.diagnosis import diagnose
from quasiharmonic.problem.result import MapResult, Status, Step
from quasiharmonic.targets import filled, nearest_on_boundary, outline_curves
from quasiharmonic.targets.boundary.boundary_to import find_corner_vertices, place_beside
from quasiharmonic.targets.cuts.find import find_cuts
from quasiharmonic.ui.studio import recipes
from quasiharmonic.ui.studio.recipes import FIXED, SEAMS, START, Code, Given, Recipe, Script, Source, public
from quasiharmonic.ui.studio.state import IslandState, SessionState
from quasiharmonic.ui.studio.validation import Outline, RequestError
from quasiharmonic.util.arrays import FloatArray, IntArray

Callback = Callable[[Step], object] | None
# Options of the smoothing after a search.
_SMOOTHING: dict[str, Any] = {"energy": "blend", "max_iterations": SMOOTHING_STEPS}


class Interrupted(KeyboardInterrupt):
    """A step was interrupted; ``mesh`` has the best map so far."""

    def __init__(self, mesh: SeamedMesh) -> None:
        super().__init__()
        self.mesh = mesh


def find_source(state: SessionState, *, with_map: bool) -> Source:
    """Return the file from which a step starts; ``with_map`` if the step depends on the current map."""
    if state.sheet.is_file and state.from_file and (state.recipe.of_file or not with_map):
        return Source(state.sheet.name, None)
    return make_start(state.mesh)


def make_start(mesh: SeamedMesh) -> Source:
    """Return a file with a map that the page saves."""
    return Source(START, MeshData(mesh.V, mesh.F, vt=mesh.uv, FT=None if mesh.uv is None else mesh.FT))


def record_start(mesh: SeamedMesh) -> Recipe:
    """Return the recipe of a map that no step makes: the file with it."""
    source = make_start(mesh)
    script = Script()
    script.let("mesh", public(as_seamed_mesh)(source.name))
    return Recipe(f"qhm check {source.name}", str(script), source.start)


def list_selected(state: SessionState) -> list[int] | None:
    """Return the selected islands; None if these are all."""
    return None if len(state.selected) == len(state.islands) else list(state.selected)


def map_to_outline(
    state: SessionState,
    outline: Outline,
    corners: Sequence[tuple[int, int]] | Literal["auto"] = (),
    callback: Callback = None,
) -> SessionState:
    """Map the boundaries of the selected islands to an outline.

    ``corners`` are boundary vertices of the first selected island and the outline's corners that they go to. "auto"
    chooses vertices by angle; without corners arc length decides.
    """
    only = list_selected(state)
    source = find_source(state, with_map=only is not None)
    own = state.active.island.vertices
    named = () if isinstance(corners, str) else tuple((int(own[v]), k) for v, k in corners)
    word = corners if corners == "auto" else ",".join(f"{v}:{k}" for v, k in named) or None
    chosen: dict[int, int] | str = corners if isinstance(corners, str) else dict(named)
    options = {
        "to": Given(outline.contours, outline.to, {"to": outline.to}, outline.texts),
        "corners": Given(chosen, chosen, {"corners": word}) if chosen else None,
    }
    mapped, recipe = _map(state.mesh, source, options, {}, only, callback)
    after = _diagnose_selected(rebuild(state, mapped, replace(recipe, outline=outline.to)))
    for i, k in enumerate(state.selected):
        one, by_angle = after.islands[k], corners == "auto"
        copy = place_beside(outline.contours, i)
        onto = filled(copy) if len(one.loops) == 1 else copy
        assert one.fixed is not None
        assert one.target is not None
        given = () if i or isinstance(corners, str) else tuple(corners)
        found = tuple(find_corner_vertices(one.fixed, one.target, onto))
        one = replace(one, outline=outline, corners=found, chosen=given, by_angle=by_angle)
        after = after.with_island(k, one)
    return after


def assign_corner(state: SessionState, k: int, vertex: int, callback: Callback = None) -> SessionState:
    """Assign the boundary vertex of island ``k`` nearest to ``vertex`` to the next corner of its outline.

    RequestError if there is no outline; ValueError if the order of the corners differs from that of the vertices.
    """
    one = state.islands[k]
    outline = require_outline(one)
    near = int(nearest_on_boundary(one.island.V, one.island.F, one.island.V[vertex][None])[0])
    before = tuple((v, c) for v, c in one.chosen if v != near)
    if len(before) >= max(len(one.corners), 1):
        before = ()
    chosen = (*before, (near, len(before)))
    return map_to_outline(replace(state, selected=(k,)), outline, chosen, callback)


def map_in_place(
    state: SessionState, start: SeamedMesh, only: list[int] | None, callback: Callback = None, follows: bool = False
) -> SessionState:
    """Map islands with their fixed vertices at the positions that they have in ``start``.

    With ``follows``, ``start`` is injective. It is then improved if the search from scratch finds no map.
    """
    source = find_source(state, with_map=True) if start is state.mesh else make_start(start)
    fixed = {"fixed": _list_fixed(state, only)}
    mapped, recipe = _map(start, source, fixed, fixed, only, callback)
    done = mapped.islands if only is None else [mapped.islands[k] for k in only]
    anew = not follows or all(one.result.injective for one in done)
    if not anew:
        mapped, recipe = recipes.perform(atlas.polish, start, source, "again.obj", _SMOOTHING | fixed, only, callback)
    recipe = replace(recipe, anew=anew, dragged=start is not state.mesh)
    return _diagnose_selected(rebuild(state, mapped, recipe, keep=("pins", "corners")))


def move_target(
    state: SessionState, k: int, target: FloatArray, uv: FloatArray | None
) -> tuple[SessionState, SeamedMesh]:
    """Return the state with one island selected and its target moved to ``target`` (k, 2); and the mesh so moved.

    ``uv`` (m, 2) is an injective map with this target, if there is one.
    """
    one = state.islands[k]
    places = [island.uv for island in state.mesh.islands]
    assert one.result is not None
    assert one.fixed is not None
    own = (one.result.uv if uv is None else uv).copy()
    own[one.fixed] = target
    places[k] = own * one.sign
    moved = replace(state.with_island(k, one.with_target(target)), selected=(k,))
    return moved, state.mesh.with_places(places)


def _map(
    start: SeamedMesh,
    source: Source,
    options: dict[str, Any],
    fixed: dict[str, Any],
    only: list[int] | None,
    callback: Callback,
) -> tuple[MappedAtlas, Recipe]:
    """Search for maps with ``options`` and smooth small injective ones, as ``qhm map`` does.

    ``fixed`` has the option of the smoothing that fixes vertices, or is empty. Raise Interrupted after an interrupt.
    """
    script = Script()
    mesh = script.let("mesh", public(atlas.injective_map)(source.name, **options, islands=only).mesh)
    mapped = atlas.injective_map(start, islands=only, callback=callback, **recipes.values(options))
    _check_finished(mapped)
    chosen = range(len(mapped.islands)) if only is None else only
    some = [k for k in chosen if _can_be_smoothed(mapped, k)]
    if some:
        again = only if len(some) == len(chosen) else some
        script.let("mesh", public(atlas.polish)(mesh, **fixed, **_SMOOTHING, islands=again).mesh)
        smoothed = atlas.polish(mapped.mesh, **recipes.values(fixed), **_SMOOTHING, islands=again, callback=callback)
        _check_finished(smoothed)
        islands = [*mapped.islands]
        for k in some:
            # Convergence is not the goal here, so the status does not report its absence.
            result = smoothed.islands[k].result.after(islands[k].result)
            islands[k] = replace(smoothed.islands[k], result=replace(result, status=Status.INJECTIVE))
        mapped = MappedAtlas(smoothed.mesh, tuple(islands))
    return mapped, recipes.record_call("map", source, "again.obj", options, script, only)


def _diagnose_selected(state: SessionState) -> SessionState:
    """Return the state with a diagnosis of the selected islands whose map is not bijective."""
    for k in state.selected:
        one = state.islands[k]
        if one.result is not None and not one.result.certificate.bijective and one.result.diagnosis is None:
            found = replace(one.result, diagnosis=diagnose(one.problem))
            state = state.with_island(k, replace(one, result=found).with_problem(one.problem))
    return state


def _can_be_smoothed(mapped: MappedAtlas, k: int) -> bool:
    """Whether an island has an injective map that `smooth` would change."""
    return mapped.islands[k].result.injective and is_smoothable(mapped.mesh.islands[k].V, mapped.mesh.islands[k].F)


def polish_islands(state: SessionState, energy: str, slide: bool, callback: Callback = None) -> SessionState:
    """Lower an energy of the selected islands until it converges."""
    only, source = list_selected(state), find_source(state, with_map=True)
    outline = state.active.outline if slide and len(state.islands) == 1 else None
    curves = slide if outline is None else _sliding_curves(outline)
    options = {"energy": energy, "slide": curves, "fixed": _list_fixed(state, only, slide=slide)}
    mapped, recipe = recipes.perform(atlas.polish, state.mesh, source, "again.obj", options, only, callback)
    recipe = replace(recipe, outline=None if outline is None else outline.to)
    return rebuild(state, mapped, recipe, keep=("pins", "corners", "outline", "chosen", "by_angle"))


def _sliding_curves(outline: Outline) -> Given:
    """Return the curves of an outline, for a boundary that slides."""
    code = public(BoundaryCurves)(public(outline_curves)(outline.to))
    return Given(BoundaryCurves(outline.curves()), code, {"slide": True, "to": outline.to}, outline.texts)


def flatten_islands(state: SessionState, callback: Callback = None) -> SessionState:
    """Flatten the selected islands with free boundaries; all of them along the wanted seams if these changed."""
    if state.wanted_seams is not None:
        return _flatten_along(state, state.wanted_seams, callback)
    mesh, only = state.mesh, list_selected(state)
    pins = _list_pins(state, state.selected)
    source = find_source(state, with_map=only is not None or pins is not None)
    cut = only is None and not all(is_flattenable(one.island) for one in state.islands)
    if not cut:
        mapped, recipe = recipes.perform(atlas.flatten, mesh, source, "flat.obj", {"fixed": pins}, only, callback)
        return rebuild(state, mapped, recipe, keep=("pins",))
    script = Script()
    cuts = _record_cut(state, source, script, script.let("mesh", public(as_seamed_mesh)(source.name)))
    script.let("mesh", public(atlas.flatten)(cuts).mesh)
    mapped = atlas.flatten(cut_apart(mesh, polygons=_polygons(state, source), disks_too=True), callback=callback)
    recipe = recipes.record_call("flatten", source, "flat.obj", {}, script, words=["--cut"])
    return replace(rebuild(state, mapped, recipe), from_file=False)


def _list_pins(state: SessionState, islands: Sequence[int]) -> Given | None:
    """Return the pins of some islands, in the surface's numbering; None if there are none."""
    pins = [int(state.islands[k].island.vertices[v]) for k in islands for v in state.islands[k].pins]
    return recipes.saved_rows(FIXED, "fixed", np.array(pins)) if pins else None


def repair_islands(state: SessionState, callback: Callback = None) -> SessionState:
    """Make inverted triangles positive; boundaries, pins, and all vertices that need not move keep their positions.

    If the only island is mirrored, it is reflected.
    """
    source, mesh = find_source(state, with_map=True), state.mesh
    options = {"fixed": _list_pins(state, range(len(state.islands))), "unmirror": state.is_mirrored}
    assert mesh.uv is not None
    result = repair(mesh.V, mesh.F, mesh.uv, FT=mesh.FT, callback=callback, **recipes.values(options))
    script = Script()
    code = script.let("mesh", public(as_seamed_mesh)(source.name))
    script.let("mesh", public(repair)(code.V, code.F, code.uv, FT=code.FT, **options).mesh)
    recipe = recipes.record_call("repair", source, "repaired.obj", options, script)
    after = rebuild_from_mesh(state, result.mesh, recipe, keep=("pins",))
    for k, (one, done) in enumerate(zip(after.islands, result.islands, strict=False)):
        if one.result is not None and done.diagnosis is not None:
            after = after.with_island(k, replace(one, result=replace(one.result, diagnosis=done.diagnosis)))
    return after


def is_flattenable(island: Island) -> bool:
    """Whether an island has a boundary and no handle."""
    found, n = edges(island.F, len(island.vertices)), len(island.vertices)
    loops = len(trace_loops(found.boundary))
    return loops > 0 and n - len(found.interior) - len(found.boundary) + len(island.F) == 2 - loops


def _check_finished(mapped: MappedAtlas) -> None:
    """Raise Interrupted if a step has been interrupted."""
    if any(one.result.status is Status.INTERRUPTED for one in mapped.islands):
        raise Interrupted(mapped.mesh)


def rebuild(state: SessionState, mapped: MappedAtlas, recipe: Recipe, keep: Collection[str] = ()) -> SessionState:
    """Return the state after a step; islands that are the same keep the constraints named in ``keep``.

    Islands that were not selected and have not moved are unchanged. All islands are selected if their number changes.
    """
    _check_finished(mapped)
    selected = state.selected if len(mapped.islands) == len(state.islands) else tuple(range(len(mapped.islands)))
    islands = []
    for k, (island, one) in enumerate(zip(mapped.mesh.islands, mapped.islands, strict=True)):
        before = state.islands[k] if k < len(state.islands) else None
        same = before is not None and np.array_equal(before.island.F, island.F)
        if before is not None and same and k not in selected and np.array_equal(island.uv, before.island.uv):
            islands.append(before)
            continue
        if np.isnan(island.uv).any():
            islands.append(IslandState(island))
            continue
        # The atlas may have shifted an island after it was mapped.
        result = one.result
        uv = island.uv * MIRROR if one.mirrored else island.uv
        if not np.array_equal(uv, result.uv):
            result = replace(result, uv=uv, certificate=certify(island.F, uv))
        new = IslandState(island, one.mirrored, result)
        if same:
            new = replace(new, **{name: getattr(before, name) for name in keep})
        islands.append(fix_in_place(new))
    return replace(state, mesh=mapped.mesh, islands=tuple(islands), recipe=recipe, selected=selected, wanted_seams=None)


def rebuild_from_mesh(
    state: SessionState, mesh: SeamedMesh, recipe: Recipe, keep: Collection[str] = ()
) -> SessionState:
    """Return the state with the map of a mesh, like `rebuild`."""
    done = []
    for island, mirrored in zip(mesh.islands, mirrored_islands(mesh), strict=True):
        uv = island.uv * MIRROR if mirrored else island.uv
        found = certify(island.F, uv)
        result = MapResult(uv=uv, status=Status.INJECTIVE if found.injective else Status.STALLED, certificate=found)
        done.append(MappedIsland(island.triangles, mirrored, result))
    return rebuild(state, MappedAtlas(mesh, tuple(done)), recipe, keep)


def fix_in_place(one: IslandState) -> IslandState:
    """Return an island whose boundary and pins are fixed at their positions in its map."""
    assert one.result is not None
    edge = np.unique(boundary_edges(one.island.F, len(one.island.vertices)))
    fixed = np.union1d(edge, np.array(one.pins, dtype=np.int64))
    return replace(one, fixed=fixed, target=one.result.uv[fixed])


def pin_vertices(state: SessionState, k: int, pins: Sequence[int]) -> SessionState:
    """Return a state with these pins of island ``k`` at their positions; the map stays the same."""
    one = state.islands[k]
    assert one.result is not None
    pinned = fix_in_place(replace(one, pins=tuple(pins)))
    return replace(state.with_island(k, pinned), selected=(k,))


def _list_fixed(state: SessionState, only: Sequence[int] | None, *, slide: bool = False) -> Given | None:
    """Return the fixed vertices of the selected islands, in the surface's numbering; None if these are the boundary.

    With ``slide``, only the pins are fixed.
    """
    chosen = state.islands if only is None else [state.islands[k] for k in only]
    if not any(one.pins for one in chosen):
        return None
    rows = []
    for one in chosen:
        boundary = boundary_edges(one.island.F, len(one.island.vertices))[: 0 if slide else None]
        rows.append(one.island.vertices[np.union1d(boundary, np.array(one.pins, int))])
    return recipes.saved_rows(FIXED, "fixed", np.unique(np.concatenate(rows)))


def _polygons(state: SessionState, source: Source) -> Any:
    return state.sheet.mesh.polygons if source.start is None else None


def _record_cut(state: SessionState, source: Source, script: Script, mesh: Code) -> Code:
    """Append to a script that a mesh is cut as ``--cut`` does, and return the variable of the mesh."""
    inside = None
    if _polygons(state, source) is not None:
        inside = script.let("inside", public(read_mesh)(source.name).polygons.diagonals(mesh.F))
    cuts = public(find_cuts)(mesh.V, mesh.F, edges=mesh.seams, forbidden_edges=inside)
    return script.let("mesh", mesh.cut(cuts))


def _flatten_along(state: SessionState, seams: IntArray, callback: Callback) -> SessionState:
    """Flatten the whole surface, cut along seams (k, 2), and where this is not enough."""
    surface = state.sheet.surface
    source = Source(state.sheet.name, None) if state.sheet.is_file else make_start(SeamedMesh(surface.V, surface.F))
    polygons = _polygons(state, source)
    mesh = SeamedMesh(surface.V, surface.F)
    if len(seams):
        mesh = cut_along(mesh, seams, polygons=polygons)
    cut = not all(is_flattenable(island) for island in mesh.islands)
    if cut:
        mesh = cut_apart(mesh, polygons=polygons, disks_too=True)
    mapped = atlas.flatten(mesh, callback=callback)
    saved = recipes.saved_rows(SEAMS, "seams", seams)
    script = Script()
    code = script.let("mesh", public(as_seamed_mesh)(source.name))
    code = script.let("mesh", public(SeamedMesh)(code.V, code.F))
    if len(seams):
        code = script.let("mesh", code.cut(saved.code))
    if cut:
        code = _record_cut(state, source, script, code)
    script.let("mesh", public(atlas.flatten)(code).mesh)
    words = {"seams": SEAMS if len(seams) else "none", "cut": cut}
    options = {"seams": replace(saved, words=words, texts=saved.texts if len(seams) else {})}
    recipe = recipes.record_call("flatten", source, "flat.obj", options, script)
    after = rebuild(state, mapped, recipe)
    return replace(after, from_file=False).select_all()


def require_outline(one: IslandState) -> Outline:
    """Return the outline of an island's boundary; RequestError if there is none."""
    if one.outline is None:
        raise RequestError("corners need an outline: choose one under Boundary first")
    return one.outline


def require_map(state: SessionState) -> None:
    """Raise RequestError unless the selected islands have maps."""
    if any(state.islands[k].result is None for k in state.selected):
        raise RequestError("there is no map yet: press Unwrap or Flatten first")


def require_not_mirrored(state: SessionState) -> None:
    """Raise RequestError if the only island is mirrored."""
    if state.is_mirrored:
        raise RequestError("the map is mirrored: press Mirror or Repair, which reflect it")


def require_injective(state: SessionState) -> None:
    """Raise RequestError if the map of a selected island has inverted triangles."""
    require_map(state)
    require_not_mirrored(state)
    bad = [k for k in state.selected if not state.islands[k].injective]
    if bad:
        which = "the map has" if len(state.islands) == 1 else f"island {bad[0]} has"
        raise RequestError(f"{which} inverted triangles: press Repair, or undo")
