"""Models that a studio page opens: parts, holes, closed surfaces, images, and invalid files."""

from __future__ import annotations

import tempfile
from dataclasses import replace

import numpy as np
import pytest

from quasiharmonic import atlas, inspect_mesh, io
from quasiharmonic.geometry.mesh.topology import are_sides
from quasiharmonic.surfaces import annulus, cat, grid, starfish
from quasiharmonic.ui.studio import setup
from quasiharmonic.ui.studio.setup import make_first_state, unwrap_model
from quasiharmonic.ui.studio.surface import MAX_TRIANGLES, make_sheet
from quasiharmonic.ui.studio.validation import RequestError
from shared.gltf_files import SQUARE, opened, touching_squares
from shared.pages import Visitor


@pytest.mark.slow
def test_holes_closed_surfaces_and_planes_are_accepted():
    ring = Visitor(*annulus(8))
    assert ring.last("map").header["bijective"]
    assert ring.last("surface").header["loops"] == [32, 16]
    ring.does("outline", to="ring:0.5")
    assert ring.last("map").header["bijective"]
    assert ring.session.state.active.outline.to == "ring:0.5"
    star = make_first_state(make_sheet(io.MeshData(*starfish(3, 8), source="star.obj"), "star.obj"))
    assert len(star.islands) == 1
    assert len(star.active.island.F) == 12 * 64
    assert star.result.certificate.bijective
    assert star.recipe.command == "qhm flatten star.obj --cut -o flat.obj"


def test_a_boundary_of_three_vertices_opens(visitor):
    """It has no map to a square, whose corners need four."""
    content = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv .2 .2 1\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    visitor.does("load", {"content": np.frombuffer(content, np.uint8)}, name="tent.obj")
    assert visitor.session.state.sheet.name == "tent.obj"
    assert visitor.session.state.result.certificate.bijective


def test_a_file_with_a_long_name_opens(visitor):
    content, name = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nf 1 2 3\nf 4 3 2\n", "a" * 196 + ".obj"
    visitor.does("load", {"content": np.frombuffer(content, np.uint8)}, name=f"folder/{name}"[-200:])
    assert visitor.session.state.sheet.name == name


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("notes.txt", b"hello", ".txt files cannot be read as a surface"),
        ("a.obj", b"v 0 0 0\nf 1 2 3\n", "a.obj"),
        ("a.obj", b"\x00\xff" * 50, "a.obj"),
        ("a.ply", b"ply\nformat", "a.ply"),
        ("a.glb", b"glTF", "a.glb"),
        ("../../etc/passwd", b"", "passwd: has no suffix"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "a.obj"),
    ],
)
def test_invalid_meshes_are_rejected_with_a_message_about_the_users_file(name, content, says, visitor):
    before = visitor.session.state
    # The reason comes last, because a surface hides what was said before.
    text = visitor.does("load", {"content": np.frombuffer(content, np.uint8)}, name=name)[-1].header["text"]
    assert says in text
    assert tempfile.gettempdir() not in text
    assert "dropped" not in text
    assert visitor.session.state is before


def test_too_many_triangles_are_rejected():
    V, F = grid(4, 4)
    many = np.broadcast_to(F[:1], (MAX_TRIANGLES + 1, 3))
    with pytest.raises(ValueError, match=r"1,000,001 triangles, but the page shows at most 1,000,000"):
        make_sheet(io.MeshData(V, many, source="big.obj"), "big.obj")


@pytest.mark.slow
def test_several_parts_are_shown_together_and_changed_one_by_one():
    (V, F), (W, G) = cat(6), cat(5)
    one = Visitor(np.concatenate([V, W + 3]), np.concatenate([F, G + len(V)]))
    surface, shown = one.last("surface"), one.last("map").header
    assert surface.header["triangles"] == len(F) + len(G)
    assert surface.header["first_triangles"] == [0, len(F)]
    first = surface.header["starts"][1]
    assert shown["count"] == 2
    assert shown["bijective"]
    before = one.session.state.uv
    one.does("select", islands=[1])
    assert one.last("map").header["selected"] == [1]
    one.does("outline", to="rect:1x1")
    after = one.session.state.uv
    assert np.array_equal(before[:first], after[:first])
    assert not np.array_equal(before[first:], after[first:])
    assert "--islands 1" in one.last("map").header["command"]
    # A drag sends the positions of its island alone.
    corner = one.session.state.corners[0]
    moved = one.drags(corner, (after[corner] + 0.01).tolist())[0]
    assert moved.header["start"] == first
    assert len(moved.arrays["places"]) == len(before) - first
    one.does("pack")
    assert one.last("map").header["overlapping"] == 0
    assert one.last("map").header["bijective"]
    assert 0.3 < one.last("map").header["used"] < 1


@pytest.mark.slow
def test_overlapping_islands_are_reported():
    (V, F), (W, G) = cat(6), cat(5)
    one = Visitor(np.concatenate([V, W + 3]), np.concatenate([F, G + len(V)]))
    one.does("select", islands=[0])
    one.does("outline", to="disk")
    one.does("select", islands=[1])
    one.does("outline", to="disk")
    shown = one.last("map").header
    assert (shown["injective"], shown["bijective"], shown["overlapping"]) == (True, False, 1)
    assert "1 pair overlaps" in shown["verdict"]


@pytest.mark.slow
def test_seams_have_one_number_on_both_sides():
    one = Visitor(*starfish(3, 8))
    seams = one.last("seams")
    edges, chain = seams.arrays["edges"], seams.arrays["chain"]
    origin = one.session.state.numbering.origin
    pairs = np.sort(origin[edges], axis=1)
    found, times = np.unique(pairs, axis=0, return_counts=True)
    assert np.array_equal(found, one.session.state.mesh.seams)
    assert (times == 2).all()
    for pair in found:
        assert len(set(chain[(pairs == pair).all(axis=1)].tolist())) == 1
    assert seams.header["chains"] > 1


def test_seams_are_drawn_along_the_shortest_path_and_erased():
    one = Visitor(*cat(8))
    V = one.session.state.numbering.V
    start, end = int(np.argmin(V[:, 0])), int(np.argmax(V[:, 0]))
    one.does("seam", start=start, vertex=end)
    drawn = one.session.state.wanted_seams
    length = np.linalg.norm(V[drawn[:, 0]] - V[drawn[:, 1]], axis=1).sum()
    assert np.linalg.norm(V[start] - V[end]) <= length < 1.5 * np.linalg.norm(V[start] - V[end])
    assert one.last("map").header["drawn"]
    (note,) = [frame for frame in one.does("polish", energy="mips", slide=False) if frame.header["kind"] == "note"]
    assert "press Unwrap or Flatten" in note.header["text"]
    one.does("flatten")
    assert one.last("map").header["count"] == 2
    assert one.last("map").header["bijective"]
    one.does("erase", vertex=start)
    one.does("flatten")
    assert one.last("map").header["count"] == 1


@pytest.mark.slow
def test_a_model_that_is_inside_out_is_recognised_and_turned():
    V, F = starfish(3, 8)
    one = Visitor(V, F[:, ::-1])
    shown = one.last("map").header
    assert (shown["inward"], shown["injective"]) == (1, True)
    one.does("turn")
    shown = one.last("map").header
    assert (shown["inward"], shown["turned"], shown["bijective"]) == (0, True, True)
    one.does("undo")
    assert one.last("map").header["inward"] == 1


def quads(n=24, m=12):
    """Return vertices and quadrilaterals of a band of a sphere from pole to pole."""
    theta, phi = np.linspace(0.3, np.pi - 0.3, m + 1), 2 * np.pi / n * np.arange(n)
    z, r = np.repeat(np.cos(theta), n), np.repeat(np.sin(theta), n)
    V = np.stack([r * np.cos(np.tile(phi, m + 1)), r * np.sin(np.tile(phi, m + 1)), z], axis=1)
    i, j = (k.ravel() for k in np.meshgrid(np.arange(m), np.arange(n), indexing="ij"))
    Q = np.stack([i * n + j, (i + 1) * n + j, (i + 1) * n + (j + 1) % n, i * n + (j + 1) % n], axis=1)
    return V, Q


def as_obj(V, faces, mapped=0, groups=""):
    """Return an OBJ file in which the first faces have texture coordinates, in groups with these names."""
    lines = ["v {} {} {}".format(*row) for row in V.tolist()] + [f"vt {k / 99} {k % 2}" for k in range(len(V))]
    for k, face in enumerate(faces):
        if groups and k % (len(faces) // len(groups)) == 0:
            lines.append(f"g {groups[k * len(groups) // len(faces)]}")
        lines.append("f " + " ".join(f"{v + 1}/{v + 1}" if k < mapped else str(v + 1) for v in face))
    return "\n".join([*lines, ""]).encode()


@pytest.mark.slow
@pytest.mark.parametrize("step", ["as it is", "unwrapped"])
def test_a_model_that_was_turned_is_saved_like_that(visitor, tmp_path, step):
    V, Q = quads()
    caps = [np.arange(24), np.arange(24)[::-1] + 12 * 24]
    visitor.does("load", {"content": np.frombuffer(as_obj(V, [*Q[:, ::-1], *caps]), np.uint8)}, name="ball.obj")
    assert visitor.last("map").header["inward"] == 1
    visitor.does("turn")
    if step == "unwrapped":
        visitor.does("unwrap", resolution=512)
    (tmp_path / "map.obj").write_bytes(visitor.files()["map.obj"])
    saved = io.read_mesh(tmp_path / "map.obj")
    assert inspect_mesh(saved.V, saved.F).inward == 0
    assert saved.rings.sizes.max() >= 4
    assert atlas.certify(io.mapped(saved)).injective


def test_a_model_that_was_turned_is_saved_with_turned_normals(visitor, tmp_path):
    faces = "f 1/1/1 2/2/1 3/3/2\nf 1/1/1 3/3/2 4/4\n"
    corners = [f"{x} {y}" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    lines = [*(f"v {at} 0" for at in corners), *(f"vt {at}" for at in corners), "vn 0 0.0 1", "vn -0.6\t0 +.8", faces]
    visitor.does("load", {"content": np.frombuffer("\n".join(lines).encode(), np.uint8)}, name="square.obj")
    visitor.does("turn")
    (tmp_path / "map.obj").write_bytes(visitor.files()["map.obj"])
    saved = io.read_mesh(tmp_path / "map.obj")
    assert saved.normals == b"vn 0 0.0 -1\nvn 0.6\t0 -.8\n"
    assert saved.F.tolist() == [[0, 2, 1], [0, 3, 2]]
    assert saved.FN.tolist() == [[0, 1, 0], [0, -1, 1]]


@pytest.mark.slow
def test_the_rest_of_a_map_is_unwrapped_like_a_whole_model(visitor):
    V, Q = quads()
    V = V + np.random.default_rng(5).normal(0, 0.05, V.shape)
    visitor.does("load", {"content": np.frombuffer(as_obj(V, Q, 2, "ab"), np.uint8)}, name="band.obj")
    faces = [line.split() for line in visitor.files()["map.obj"].decode().splitlines() if line.startswith("f ")]
    assert [len(face) for face in faces] == [5] * len(Q)
    state = setup.open_without_map(visitor.session.state.sheet)
    meridian = np.stack([12 + 24 * np.arange(12), 36 + 24 * np.arange(12)], axis=1)
    drawn = replace(state, wanted_seams=meridian)
    for plan, options in ((drawn, {}), (state, {"labels": "groups"})):
        seams = unwrap_model(plan, **options).mesh.seams
        wanted = meridian if plan is drawn else np.stack([144 + np.arange(24), 144 + np.arange(1, 25) % 24], axis=1)
        assert are_sides(np.sort(wanted), np.pad(np.sort(seams), [(0, 0), (0, 1)], mode="edge"), len(V)).all()
    with pytest.raises(RequestError, match="the file has no materials"):
        unwrap_model(state, labels="materials")


@pytest.mark.slow
def test_charts_reach_across_vertices_at_equal_positions(visitor, tmp_path):
    V, Q = quads()
    loose, faces = V[Q.ravel()], np.arange(Q.size).reshape(-1, 4)
    visitor.does("load", {"content": np.frombuffer(as_obj(loose, faces), np.uint8)}, name="loose.obj")
    visitor.does("unwrap", resolution=512)
    assert len(visitor.session.state.islands) < 12
    assert len(visitor.session.state.overlapping) == 0
    (tmp_path / "map.obj").write_bytes(visitor.files()["map.obj"])
    saved = io.read_mesh(tmp_path / "map.obj")
    assert len(saved.V) == len(loose)
    assert saved.rings.sizes.tolist() == [4] * len(faces)
    visitor.does("flatten")
    assert visitor.session.state.injective
    sheet = make_sheet(saved, "loose.obj").clean_up()
    places = {tuple(map(tuple, np.sort(sheet.surface.V[edge], axis=0))) for edge in sheet.find_edges(faces[:9, :2])}
    assert places == {tuple(map(tuple, np.sort(saved.V[edge], axis=0))) for edge in faces[:9, :2]}


def test_names_of_drawings_are_no_options(visitor):
    drawing = b'<svg xmlns="http://www.w3.org/2000/svg"><path d="M0 0h9v9h-9z"/></svg>'
    visitor.does("drawing", {"content": np.frombuffer(drawing, np.uint8)}, name="-drop.svg")
    assert "--to drop.svg" in visitor.session.state.recipe.command


@pytest.mark.slow
def test_the_surface_is_shown_before_its_map_and_every_step_reports_progress():
    one = Visitor(*starfish(3, 8))
    kinds = [frame.header["kind"] for frame in one.frames]
    assert kinds[:2] == ["surface", "busy"]
    assert "progress" in kinds[: kinds.index("map")]
    for what in ("unwrap", "flatten"):
        answered = one.does(what)
        assert answered[0].header["kind"] == "busy"
        assert any(frame.header["kind"] == "progress" for frame in answered)
    phases = {frame.header.get("phase") for frame in one.frames if frame.header["kind"] == "progress"}
    assert {"clean", "cut", "pack", "certify"} <= phases


@pytest.mark.slow
def test_a_large_model_that_must_be_cut_opens_without_a_map(monkeypatch):
    monkeypatch.setattr("quasiharmonic.ui.studio.setup.MAX_AUTOMATIC", 100)
    one = Visitor(*starfish(3, 8))
    shown = one.last("map")
    assert not shown.header["mapped"]
    assert "places" not in shown.arrays
    for what, words in (("polish", {"energy": "mips"}), ("pack", {}), ("save", {}), ("grab", {"vertex": 0})):
        (note,) = [frame for frame in one.does(what, **words) if frame.header["kind"] == "note"]
        assert "press Unwrap" in note.header["text"]
    one.does("unwrap", resolution=512)
    assert one.last("map").header["bijective"]
    one.does("undo")
    assert not one.last("map").header["mapped"]


def test_a_gltf_file_keeps_its_materials_and_losses_are_reported(tmp_path):
    made = touching_squares()
    made.tree["materials"] = [
        {"name": str(k), "pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(2)
    ]
    made.tree["textures"] = [{"source": 0}, {"source": 0}]
    made.tree["images"] = [{"bufferView": made.view(io.checkerboard().data), "mimeType": "image/png"}]
    for k, mesh in enumerate(made.tree["meshes"]):
        mesh["primitives"][0] |= {"material": k}
        mesh["primitives"][0]["attributes"]["TEXCOORD_0"] = made.accessor(SQUARE[:, :2] + np.float32(k))
    path = tmp_path / "two.glb"
    path.write_bytes(made.glb())
    one = Visitor(path)
    for step, unfitting in ("stop", []), ("unwrap", ["the new coordinates"]), ("turn", ["the new coordinates"]):
        one.does(step)
        shown = one.does("save", format="glb")
        (data,) = [frame.arrays["content"].tobytes() for frame in shown if frame.header["kind"] == "file"]
        tree = opened(data)[0]
        assert tree["materials"] == made.tree["materials"]
        assert [mesh["primitives"][0]["material"] for mesh in tree["meshes"]] == [0, 1]
        notes = [frame.header["text"] for frame in shown if frame.header["kind"] == "note"]
        assert [note[:19] for note in notes] == unfitting
    (note,) = [frame.header["text"] for frame in one.does("save", format="ply") if frame.header["kind"] == "note"]
    assert "map.ply does not have: materials" in note


def test_an_image_is_shown_and_saved_with_the_map(tmp_path):
    one = Visitor(*cat(6))
    (note,) = one.does("image", {"content": np.frombuffer(b"no image", np.uint8)})
    assert "PNG or JPEG" in note.header["text"]
    picture = io.checkerboard().data
    (shown,) = one.does("image", {"content": np.frombuffer(picture, np.uint8)})
    assert (shown.header["kind"], shown.header["type"]) == ("image", "image/png")
    for form in ("glb", "obj"):
        for frame in one.does("save", format=form):
            if frame.header["kind"] == "file":
                (tmp_path / frame.header["name"]).write_bytes(frame.arrays["content"].tobytes())
    for name in ("map.glb", "map.obj"):
        assert io.own_texture(io.read_mesh(tmp_path / name)).data == picture
    # The model's own image is shown when it is opened.
    assert Visitor(tmp_path / "map.glb").last("image").arrays["content"].tobytes() == picture


@pytest.mark.parametrize("spoilt", [False, True])
@pytest.mark.parametrize("large", [False, True])
def test_triangles_without_texture_coordinates_are_added_to_those_with(tmp_path, monkeypatch, large, spoilt):
    """The others keep theirs, bit for bit; a large model waits for *Unwrap*. One model has a repeated triangle."""
    (V, F), (W, G) = cat(6), grid(5, 5)
    W = np.pad(W, [(0, 0), (0, 1)]) + 3.0
    uv = W[:, :2] * np.array([0.4, 0.3])
    FT = np.concatenate([np.full_like(F, -1), G, G[: int(spoilt)]])
    mesh = io.MeshData(np.concatenate([V, W]), np.concatenate([F, G + len(V), G[: int(spoilt)] + len(V)]), vt=uv, FT=FT)
    io.write_obj(tmp_path / "model.obj", mesh)
    if large:
        monkeypatch.setattr(setup, "MAX_AUTOMATIC", len(F) - 1)
    one = Visitor(tmp_path / "model.obj")
    note = one.last("note").header["text"]
    assert f"{len(F)} of {len(F) + len(G)} triangles of model.obj lack texture coordinates" in note
    assert one.session.state.mapped is not large
    if large:
        assert "press Unwrap" in note
        one.does("unwrap", resolution=256)
    state = one.session.state
    assert state.injective
    assert not len(state.overlapping)
    saved = state.sheet.mapped_file(state.mesh)
    assert np.array_equal(saved.corner_uv[len(F) : len(F) + len(G)], mesh.corner_uv[len(F) : len(F) + len(G)])
    assert saved.corner_uv[: len(F), :, 0].min() >= 2


def test_a_map_is_kept_if_only_a_repeated_triangle_has_no_coordinates(tmp_path):
    V, F = grid(5, 5)
    mesh = io.MeshData(
        np.pad(V, [(0, 0), (0, 1)]), np.vstack([F, F[:1]]), vt=0.3 * V, FT=np.vstack([F, -np.ones_like(F[:1])])
    )
    io.write_obj(tmp_path / "model.obj", mesh)
    one = Visitor(tmp_path / "model.obj")
    assert one.session.state.mapped
    saved = one.session.state.sheet.mapped_file(one.session.state.mesh)
    assert np.array_equal(saved.corner_uv[: len(F)], mesh.corner_uv[: len(F)])
