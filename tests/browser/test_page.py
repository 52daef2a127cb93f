"""The page in a browser: every action of a visitor, and invalid input."""

from __future__ import annotations

import time

import numpy as np
import pytest

from quasiharmonic import certify, io, is_injective
from quasiharmonic.io import checkerboard

SVG = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 10 10"><path d="M0 0 H10 V4 H4 V10 H0 Z"/></svg>'

# The maps that the page has shown, and its status text at that time.
RECORD = """() => {
  const view = studio.view, receive = view.receive.bind(view);
  window.seen = [];
  view.receive = (frame) => {
    receive(frame);
    const { header, arrays } = frame;
    if (header.kind === "map" && arrays.places) window.seen.push({
      seq: header.seq, injective: header.injective, reached: header.reached, flips: header.flips,
      places: Array.from(arrays.places), origin: header.origin,
    });
  };
}"""


def until(page, expression, seconds=60):
    """Wait for a condition; the page's security policy forbids evaluating strings."""
    end = time.monotonic() + seconds
    while not page.evaluate(expression):
        assert time.monotonic() < end, expression
        page.wait_for_timeout(2)


def triangles(page):
    return np.array(page.evaluate("Array.from(studio.view.scene.triangles)"), dtype=np.int64).reshape(-1, 3)


def point_of(page, vertex):
    """Return the screen position of a vertex of the map."""
    x, y = page.evaluate("v => studio.view.hands.plane.pointOf(...studio.view.scene.placeOf(v))", vertex)
    box = page.locator("#view").bounding_box()
    return box["x"] + x, box["y"] + y


def corner(page, number):
    return page.evaluate("k => studio.view.scene.corners[k]", number)


def drag(page, vertex, path, *, release=True):
    """Grab a vertex and move along a path on the screen, relative to its position."""
    x, y = point_of(page, vertex)
    page.mouse.move(x, y)
    page.mouse.down()
    for dx, dy in path:
        page.mouse.move(x + dx, y + dy)
        until(page, "!studio.view.hands.inFlight && !studio.view.hands.next")
    if release:
        page.mouse.up()


def wait_for_new_rest(page, settled):
    page.wait_for_timeout(50)
    settled(page)


def deed(page, settled, do):
    """Do something and wait for the resulting map."""
    page.evaluate("document.body.dataset.state = 'asked'")
    do()
    settled(page)


def test_a_first_visit_shows_a_certified_map_and_what_to_drag(serving, opened):
    with serving() as address:
        first_visit(opened(address))


def first_visit(page):
    assert "no inverted triangle, no overlap" in page.inner_text("#verdict")
    assert "orange corner" in page.inner_text("#hint")
    assert "qhm map cat.obj --to rect:1x1" in page.inner_text("#command")
    # Both panes contain drawings.
    drawn = page.evaluate("""() => {
      const canvas = studio.view.picture(), context = canvas.getContext("2d");
      return [0.25, 0.75].map(x => {
        const data = context.getImageData(canvas.width * x - 40, canvas.height / 2 - 40, 80, 80).data;
        return new Set(new Uint32Array(data.buffer)).size;
      });
    }""")
    assert min(drawn) > 20


def test_the_map_follows_the_pointer_without_inverted_triangles_in_any_frame(address, opened, settled):
    page = opened(address)
    page.evaluate(RECORD)
    vertex = corner(page, 2)
    drag(page, vertex, [(-3 * k, 2 * k + 10 * np.sin(k / 4)) for k in range(40)])
    wait_for_new_rest(page, settled)
    seen = page.evaluate("seen.filter(one => one.seq >= 0)")
    F = triangles(page)
    assert len(seen) > 30
    assert all(one["injective"] and one["flips"] == 0 and one["reached"] for one in seen)
    uv = [np.array(one["places"]).reshape(-1, 2) for one in seen]
    # In the single precision of the drawing, and in every picture.
    assert all(is_injective(F, one) for one in uv)
    moved = np.ptp([one[vertex] for one in uv], axis=0)
    assert np.all(moved > 0.1)
    assert len({one.tobytes() for one in uv}) == len(uv)


def grains(page):
    """Return the width in pixels of the canvas of triangles, and of the one above it."""
    return page.evaluate("Array.from(document.querySelectorAll('#view canvas'), canvas => canvas.width)")


@pytest.mark.parametrize("milliseconds", [1000, 1])
def test_pictures_are_coarser_only_during_a_drag_with_slow_drawing(address, opened, settled, milliseconds):
    page = opened(address)
    page.evaluate(f"Object.defineProperty(studio.view.clock, 'whole', {{ get: () => {milliseconds}, set() {{}} }})")
    whole = grains(page)
    assert whole[0] == whole[1]
    x, y = point_of(page, corner(page, 2))
    page.mouse.move(x, y)
    page.mouse.down()
    seen = []
    for k in range(12):
        page.mouse.move(x - 2 * k, y + k)
        until(page, "!studio.view.hands.inFlight && !studio.view.hands.next")
        page.evaluate("new Promise(drawn => requestAnimationFrame(drawn))")
        seen.append(grains(page))
    assert (min(seen)[0] < whole[0] / 2) == (milliseconds > 100)
    # Red triangles are never coarse.
    red = "(view => view.show(view.scene.places, new Uint32Array([0])))(studio.view)"
    picture = "new Promise(drawn => requestAnimationFrame(() => drawn(document.querySelector('#view canvas').width)))"
    assert page.evaluate(f"{red}, {picture}") == whole[0]
    page.mouse.up()
    settled(page)
    assert grains(page) == whole


def test_pin_undo_and_redo(address, opened, settled):
    page = opened(address)
    before = page.evaluate("Array.from(studio.view.scene.places)")
    page.check("input[value=pin]")
    box = page.locator("#view").bounding_box()
    deed(page, settled, lambda: page.mouse.click(box["x"] + box["width"] * 0.25, box["y"] + box["height"] * 0.52))
    (pin,) = page.evaluate("studio.view.scene.pins")
    page.check("input[value=move]")
    place = page.evaluate("v => studio.view.scene.placeOf(v)", pin)
    deed(page, settled, lambda: drag(page, pin, [(4 * k, -3 * k) for k in range(12)]))
    now = page.evaluate("v => studio.view.scene.placeOf(v)", pin)
    assert np.hypot(now[0] - place[0], now[1] - place[1]) > 0.05
    assert "no inverted triangle" in page.inner_text("#verdict")
    deed(page, settled, lambda: page.click("#undo"))
    deed(page, settled, lambda: page.keyboard.press("Control+z"))
    assert page.evaluate("Array.from(studio.view.scene.places)") == before
    deed(page, settled, lambda: page.click("#redo"))
    assert page.evaluate("studio.view.scene.pins") == [pin]


def test_the_first_drag_after_a_click_on_the_surface_moves_the_map(address, opened, settled):
    page = opened(address)
    box = page.locator(".qhm-surface").bounding_box()
    for key, step in {"": 2, "v": -2, "Shift": 2}.items():
        vertex = corner(page, 2)
        before = page.evaluate("v => studio.view.scene.placeOf(v)", vertex)
        page.mouse.click(box["x"] + 20, box["y"] + 20)
        drag(page, vertex, [(4, -3)], release=False)
        if key:  # A key that is released during the drag does not end it.
            page.keyboard.press(key)
        x, y = point_of(page, vertex)
        for k in range(12):
            page.mouse.move(x + step * k, y - step * k)
            until(page, "!studio.view.hands.inFlight && !studio.view.hands.next")
        deed(page, settled, page.mouse.up)
        now = page.evaluate("v => studio.view.scene.placeOf(v)", vertex)
        assert min(abs(now[0] - before[0]), abs(now[1] - before[1])) > 0.03, key


def test_a_letter_is_saved_and_certified(address, opened, settled, tmp_path):
    page = opened(address)
    page.select_option("#shape", "letter")
    page.fill("#letter", "G")
    deed(page, settled, lambda: page.click("#outline button"))
    assert "no overlap" in page.inner_text("#verdict")
    assert "--to letter:G" in page.inner_text("#command")
    assert (page.input_value("#shape"), page.input_value("#letter")) == ("letter", "G")
    with page.expect_download() as download:
        page.click("#save")
    download.value.save_as(tmp_path / "map.obj")
    mesh = io.read_mesh(tmp_path / "map.obj")
    assert certify(mesh.F, io.map_of(mesh)).bijective
    with page.expect_download() as download:
        page.click("#png")
    download.value.save_as(tmp_path / "map.png")
    assert (tmp_path / "map.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_an_svg_dropped_on_the_page_and_a_polygon_drawn_by_hand(address, opened, settled, tmp_path):
    page = opened(address)
    (tmp_path / "ell.svg").write_text(SVG)
    transfer = page.evaluate_handle(
        "text => { const t = new DataTransfer(); t.items.add(new File([text], 'ell.svg')); return t; }", SVG
    )
    deed(page, settled, lambda: page.dispatch_event("#view", "drop", {"dataTransfer": transfer}))
    assert "--to ell.svg" in page.inner_text("#command")
    assert page.input_value("#shape") == ""
    assert len(page.evaluate("studio.view.scene.corners")) == 6
    page.check("input[value=draw]")
    box = page.locator(".qhm-map").bounding_box()
    corners = [(0.2, 0.8), (0.8, 0.8), (0.7, 0.3), (0.5, 0.6)]

    def draw():
        for x, y in [*corners, corners[0]]:
            page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])

    deed(page, settled, draw)
    assert "--to polygon.txt" in page.inner_text("#command")
    assert len(page.evaluate("studio.view.scene.corners")) == 4
    assert "no inverted triangle" in page.inner_text("#verdict")


def test_dragged_corners_free_boundary_polish_and_slide(address, opened, settled):
    page = opened(address)
    page.check("input[value=corner]")
    box = page.locator(".qhm-surface").bounding_box()
    deed(page, settled, lambda: page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.68 * box["height"]))
    assert ":0" in page.inner_text("#command")
    assert "--corners" in page.inner_text("#command")
    energy = float(page.inner_text("#energy"))
    page.check("#slide")
    deed(page, settled, lambda: page.click("#polish"))
    assert float(page.inner_text("#energy")) < energy
    assert "--slide" in page.inner_text("#command")
    deed(page, settled, lambda: page.click("#flatten"))
    assert "qhm flatten cat.obj" in page.inner_text("#command")
    assert "no overlap" in page.inner_text("#verdict")


def test_an_outline_that_crosses_itself_is_explained(address, opened, settled):
    page = opened(address)
    page.evaluate(RECORD)
    vertex = corner(page, 2)
    x, y = point_of(page, vertex)
    far_x, far_y = point_of(page, corner(page, 0))
    # Across the left side, so that the outline crosses it twice.
    goal = far_x - x - 120, (far_y - y) / 2
    deed(page, settled, lambda: drag(page, vertex, [(goal[0] * k / 12, goal[1] * k / 12) for k in range(1, 13)]))
    words = page.inner_text("#verdict")
    assert "no overlap" not in words
    told = page.locator("#obstructions li").all_inner_texts()
    assert told
    assert page.is_visible("#why")
    page.locator("#obstructions button").first.click()
    marked = page.evaluate("studio.view.scene.obstruction")
    assert marked["edges"] or marked["vertices"]
    # The page never reported an uncertified map as certified.
    F = triangles(page)
    for one in page.evaluate("seen"):
        uv = np.array(one["places"]).reshape(-1, 2)
        assert one["injective"] == (one["flips"] == 0)
        if one["injective"] and one["seq"] >= 0:
            assert is_injective(F, uv)
    deed(page, settled, lambda: page.click("#undo"))
    assert not page.is_visible("#why")


def test_the_keyboard_moves_vertices(address, opened, settled):
    page = opened(address)
    page.focus(".qhm-map")
    page.keyboard.press("n")
    vertex = page.evaluate("studio.view.scene.chosen")
    assert vertex == corner(page, 0)
    before = page.evaluate("v => studio.view.scene.placeOf(v)", vertex)
    deed(page, settled, lambda: [page.keyboard.press("ArrowLeft") for _ in range(3)])
    # Steps that are faster than maps are all applied.
    until(page, f"studio.view.scene.placeOf({vertex})[0] < {before[0] - 0.059}")
    settled(page)
    page.focus(".qhm-surface")
    page.keyboard.press("ArrowRight")
    assert page.evaluate("studio.view.hands.space().yaw") == pytest.approx(0.12)


@pytest.mark.long
def test_two_thousand_frames_leak_no_memory(address, opened):
    page = opened(address)
    vertex = corner(page, 2)
    session = page.context.new_cdp_session(page)

    def heap():
        session.send("HeapProfiler.collectGarbage")
        return page.evaluate("performance.memory.usedJSHeapSize"), page.evaluate(
            "document.querySelectorAll('*').length"
        )

    def rounds(count):
        x, y = point_of(page, vertex)
        page.mouse.move(x, y)
        page.mouse.down()
        began = page.evaluate("studio.view.clock.frames")
        k = 0
        while page.evaluate("studio.view.clock.frames") < began + count:
            page.mouse.move(x + 30 * np.cos(k / 9), y + 30 * np.sin(k / 9))
            k += 1
        page.mouse.up()
        page.wait_for_timeout(1500)
        # The memory of the film may grow, up to its limit.
        page.evaluate("studio.film.clear()")

    rounds(100)
    before = heap()
    rounds(2000)
    after = heap()
    assert after[1] == before[1]
    assert after[0] - before[0] < 4e6
    assert page.evaluate("studio.view.clock.latencies.length") <= 1000
    assert page.evaluate("studio.view.clock.moved.size") < 100
    assert "no inverted triangle" in page.inner_text("#verdict")


def test_the_film_keeps_the_maps(address, opened, settled, tmp_path):
    page = opened(address)
    deed(page, settled, lambda: drag(page, corner(page, 1), [(5 * k, -4 * k) for k in range(8)]))
    assert page.evaluate("studio.film.maps.length") >= 8
    with page.expect_download() as download:
        page.click("#film")
    download.value.save_as(tmp_path / "map.webm")
    assert (tmp_path / "map.webm").read_bytes()[:4] == b"\x1a\x45\xdf\xa3"


def test_invalid_or_large_files_are_reported_and_the_page_continues(address, opened, settled, tmp_path):
    page = opened(address)
    (tmp_path / "notes.obj").write_text("Dear diary,\n" * 50)
    page.set_input_files("#open", tmp_path / "notes.obj")
    page.wait_for_selector("#note:not([hidden])")
    assert "notes.obj" in page.inner_text("#note")
    for name, content in {"wrong.png": b"Dear diary", "right.png": checkerboard().data}.items():
        (tmp_path / name).write_bytes(content)
        page.set_input_files("#image", tmp_path / name)
        until(page, f"document.querySelector('#note').hidden === {str(name == 'right.png').lower()}")
        until(page, f"Boolean(studio.panel.pictured) === {str(name == 'right.png').lower()}")
    assert page.is_hidden("#note"), "the image is valid"
    # Four million triangles, as in a binary STL: rejected by their size before they are sent.
    with (tmp_path / "huge.stl").open("wb") as file:
        file.write(bytes(80) + (4_000_000).to_bytes(4, "little"))
        file.truncate(84 + 50 * 4_000_000)
    page.evaluate("size => studio.take({ name: 'huge.stl', size })", (tmp_path / "huge.stl").stat().st_size)
    until(page, "document.querySelector('#note').textContent.includes('huge.stl')")
    assert "qhm map" in page.inner_text("#note")
    deed(page, settled, lambda: page.click("#outline button"))
    assert "no inverted triangle" in page.inner_text("#verdict")


def test_a_surface_of_the_visitor(address, opened, settled, tmp_path):
    page = opened(address)
    from quasiharmonic.surfaces import starfish

    V, F = starfish(5, 12)
    lines = [*(f"v {x} {y} {z}" for x, y, z in V.tolist()), *(f"f {a} {b} {c}" for a, b, c in (F + 1).tolist())]
    (tmp_path / "star.obj").write_text("\n".join(lines))
    deed(page, settled, lambda: page.set_input_files("#open", tmp_path / "star.obj"))
    until(page, "document.querySelector('#name').textContent.startsWith('star.obj')")
    settled(page)
    assert "no inverted triangle" in page.inner_text("#verdict")
    assert "--cut" in page.inner_text("#command")


def test_two_pages_and_a_server_that_stops(opened, settled, serving):
    with serving() as address:
        one, other = opened(address), opened(address)
        one.select_option("#shape", "disk")
        deed(one, settled, lambda: one.click("#outline button"))
        assert "disk" in one.inner_text("#command")
        assert "rect:1x1" in other.inner_text("#command")
        # During a drag.
        drag(other, corner(other, 0), [(-5, 5), (-9, 9)], release=False)
    other.wait_for_selector("body[data-state=gone]")
    assert "Disconnected" in other.inner_text("#verdict")
    other.mouse.move(300, 300)
    other.mouse.up()


def test_a_wrong_token_shows_nothing(address, opened):
    page = opened(address[:-4] + "xxx/", settled=False)
    assert "token" in page.inner_text("body")
    assert page.locator("#view").count() == 0
