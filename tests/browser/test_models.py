"""The page with models as people have them: several parts, seams, images, reloads, the keyboard."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.surfaces import annulus, cat, starfish

AXE = os.environ.get("AXE")
SIZES = [(1400, 850), (800, 700), (390, 800)]


def write(path, V, F):
    io.write_obj(path, io.MeshData(V, F))
    return path


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Files: a closed star, the star inside out, two parts, and a star with defects."""
    folder = tmp_path_factory.mktemp("models")
    V, F = starfish(3, 10)
    (A, G), (B, H) = cat(10), annulus(8)
    B = np.pad(B, [(0, 0), (0, 3 - B.shape[1])]) + 3.0
    fin = np.concatenate([F, F[:2], [[3, 3, 5], [*F[20, :2], len(V)]]])
    return {
        "closed": write(folder / "closed.obj", V, F),
        "inward": write(folder / "inward.obj", V, F[:, ::-1]),
        "parts": write(folder / "parts.obj", np.concatenate([A, B]), np.concatenate([G, H + len(A)])),
        "spoilt": write(folder / "spoilt.obj", np.concatenate([V, [[2.0, 2, 2]]]), fin),
    }


@pytest.fixture(scope="module")
def served_parts(serving_of_module, models):
    with serving_of_module(models["parts"]) as address:
        yield address


def act(page, settled, do):
    """Do something and wait for the resulting map."""
    page.evaluate("document.body.dataset.state = 'asked'")
    do()
    settled(page)


def test_models_are_opened_one_after_another(served_parts, opened, settled, models):
    page = opened(served_parts)
    (models["closed"].parent / "broken.obj").write_text("v 0 0 0\nf 1 2 3\n")
    page.set_input_files("#open", models["closed"].parent / "broken.obj")
    page.wait_for_selector("#note:not([hidden])")
    for name in ("closed", "spoilt", "inward", "parts"):
        act(page, settled, lambda name=name: page.set_input_files("#open", models[name]))
        page.wait_for_function(f"() => document.querySelector('#name').textContent.startsWith('{name}.obj')")
        assert "no inverted triangle, no overlap" in page.inner_text("#verdict")
        assert page.is_hidden("#note"), "what was said about the previous file"
        assert page.is_visible("#outward") == (name == "inward")


def test_islands_are_listed_selected_and_changed(served_parts, opened, settled):
    page = opened(served_parts)
    assert page.locator("#islands button").count() == 2
    act(page, settled, lambda: page.locator("#islands button").first.click())
    assert page.locator("#islands [aria-pressed=true]").count() == 1
    act(page, settled, lambda: page.click("#islands button >> nth=1", modifiers=["Shift"]))
    assert page.locator("#islands [aria-pressed=true]").count() == 2
    # Click into the map.
    x, y = page.evaluate("studio.view.hands.plane.pointOf(...studio.view.scene.placeOf(20))")
    box = page.locator("#view").bounding_box()
    act(page, settled, lambda: page.mouse.click(box["x"] + x, box["y"] + y))
    assert page.evaluate("[...studio.view.scene.selected]") == [0]
    before = page.evaluate("Array.from(studio.view.scene.places)")
    second = 2 * page.evaluate("studio.view.scene.starts[1]")
    page.select_option("#shape", "rect:2x1")
    act(page, settled, lambda: page.click("#outline button"))
    after = page.evaluate("Array.from(studio.view.scene.places)")
    moved = np.array(after) - before
    assert np.ptp(moved[second::2]) < 1e-5, "the other island keeps its shape"
    assert np.ptp(moved[:second]) > 0.1
    assert "--islands 0" in page.inner_text("#command")


def test_a_selected_island_is_dragged_and_rotated(served_parts, opened, settled):
    page = opened(served_parts)
    places = "Array.from(studio.view.scene.places, (value, i) => value + studio.view.scene.origin[i % 2])"
    act(page, settled, lambda: page.locator("#islands button").first.click())
    before, second = np.array(page.evaluate(places)), 2 * page.evaluate("studio.view.scene.starts[1]")
    middle = page.evaluate("""() => {
      const { scene, hands } = studio.view;
      const corners = [0, 1, 2].map((k) => scene.placeOf(scene.triangles[k]));
      return hands.plane.pointOf(...[0, 1].map((i) => (corners[0][i] + corners[1][i] + corners[2][i]) / 3));
    }""")
    box = page.locator("#view").bounding_box()
    x, y = box["x"] + middle[0], box["y"] + middle[1]
    page.evaluate("document.body.dataset.state = 'asked'")
    page.mouse.move(x, y)
    page.mouse.down()
    for k in range(1, 6):
        page.mouse.move(x + 8 * k, y)
    page.mouse.up()
    settled(page)
    moved = np.array(page.evaluate(places)) - before
    pixels = page.evaluate("studio.view.hands.plane.pixels")
    assert np.allclose(moved[:second:2], 40 / pixels, atol=1e-3)
    assert np.allclose(moved[1:second:2], 0, atol=1e-5)
    assert np.allclose(moved[second:], 0, atol=1e-5)
    assert page.evaluate("[...studio.view.scene.selected]") == [0]
    size = np.ptp(np.array(page.evaluate(places))[:second].reshape(-1, 2), axis=0)
    page.locator(".qhm-map").focus()
    act(page, settled, lambda: page.keyboard.press("r"))
    turned = np.ptp(np.array(page.evaluate(places))[:second].reshape(-1, 2), axis=0)
    assert turned == pytest.approx(size[::-1], abs=1e-5)
    for _ in range(2):
        act(page, settled, lambda: page.keyboard.press("Control+z"))
    assert np.allclose(page.evaluate(places), before, atol=1e-5)


def test_unwrap_shows_seams_and_the_result_is_saved_and_opened_again(served_parts, opened, settled, models, tmp_path):
    page = opened(served_parts)
    act(page, settled, lambda: page.set_input_files("#open", models["closed"]))
    page.locator("#view").click(position={"x": 5, "y": 5})
    act(page, settled, lambda: page.keyboard.press("u"))
    assert "no inverted triangle, no overlap" in page.inner_text("#verdict")
    assert page.inner_text("#command").startswith("qhm unwrap closed.obj")
    assert 30 < int(page.inner_text("#used").split()[0]) < 100
    count = page.locator("#islands button").count()
    assert count > 1
    pictures = []
    for shown in (True, False):
        page.set_checked("#seams", shown)
        page.wait_for_timeout(200)
        pictures.append(page.evaluate("studio.view.picture().toDataURL()"))
    assert pictures[0] != pictures[1]
    for button, name in (("#save", "map.obj"), ("#glb", "map.glb")):
        with page.expect_download(predicate=lambda one, name=name: one.suggested_filename == name) as download:
            page.click(button)
        download.value.save_as(tmp_path / name)
        act(page, settled, lambda name=name: page.set_input_files("#open", tmp_path / name))
        page.wait_for_function(f"() => document.querySelector('#name').textContent.startsWith('{name}')")
        assert "no inverted triangle, no overlap" in page.inner_text("#verdict")
        assert page.locator("#islands button").count() == count
        act(page, settled, lambda: page.set_input_files("#open", models["closed"]))
        act(page, settled, lambda: page.click("#unwrap"))


def test_an_image_is_dropped_shown_and_saved(served_parts, opened, tmp_path):
    page = opened(served_parts)
    before = page.evaluate("studio.view.picture().toDataURL()")
    data = list(io.checkerboard().data)
    transfer = page.evaluate_handle(
        """data => {
          const t = new DataTransfer();
          t.items.add(new File([new Uint8Array(data)], "board.png"));
          return t;
        }""",
        data,
    )
    page.dispatch_event("#view", "drop", {"dataTransfer": transfer})
    page.wait_for_selector("input[value=image]:checked", state="attached")
    page.wait_for_timeout(300)
    assert page.evaluate("studio.view.picture().toDataURL()") != before
    with page.expect_download() as download:
        page.click("#glb")
    download.value.save_as(tmp_path / "map.glb")
    assert io.own_texture(io.read_mesh(tmp_path / "map.glb")).data == bytes(data)


def test_a_model_and_its_image_are_dropped_together(served_parts, opened, models):
    page = opened(served_parts)
    page.evaluate(
        """async ([text, data]) => {
          const files = [["board.png", new Uint8Array(data)], ["dropped.obj", text], ["a.mtl", "newmtl a"]];
          await studio.takeAll(files.map(([name, content]) => new File([content], name)));
        }""",
        [models["closed"].read_text(), list(io.checkerboard().data)],
    )
    page.wait_for_selector("input[value=image]:checked", state="attached")
    assert page.inner_text("#name").startswith("dropped.obj")
    assert page.is_hidden("#note")


@pytest.mark.parametrize("motion", ["no-preference", "reduce"])
def test_maps_change_smoothly_unless_less_motion_is_preferred(served_parts, opened, settled, motion):
    page = opened(served_parts)
    page.emulate_media(reduced_motion=motion)
    act(page, settled, lambda: page.click("#flatten"))
    page.wait_for_timeout(400)
    page.evaluate("studio.view.clock.frames = 0")
    act(page, settled, lambda: page.click("#undo"))
    page.wait_for_timeout(400)
    assert (page.evaluate("studio.view.clock.frames") > 3) == (motion == "no-preference")


def test_a_reload_and_a_crash_lose_nothing(served_parts, opened, settled):
    page = opened(served_parts)
    act(page, settled, lambda: page.click("#flatten"))
    act(page, settled, lambda: page.click("#polish"))
    shown = page.evaluate("Array.from(studio.view.scene.places)")
    asked = []
    page.on("dialog", lambda dialog: [asked.append(dialog.type), dialog.accept()])
    page.click("#fit")
    page.reload()
    settled(page)
    assert asked == ["beforeunload"]
    assert page.evaluate("Array.from(studio.view.scene.places)") == shown
    kill_workers()
    page.wait_for_selector("body[data-state=restarting]")
    assert "Restarting" in page.inner_text("#verdict")
    settled(page)
    assert page.evaluate("Array.from(studio.view.scene.places)") == shown
    act(page, settled, lambda: page.click("#undo"))
    assert "qhm flatten" in page.inner_text("#command")
    # What is saved can be closed without a question.
    with page.expect_download():
        page.click("#save")
    page.wait_for_function("() => !studio.panel.unsaved")
    asked.clear()
    page.reload()
    settled(page)
    assert asked == []


def parent(process):
    """Return the number of a process's parent."""
    status = Path(f"/proc/{process}/status").read_text("utf-8").splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith("PPid:"))


def kill_workers():
    """Kill the workers of the servers that this process started."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
                own = parent(parent(int(entry.name))) == os.getpid()
            except (OSError, ValueError):
                continue
            if own and b"page_worker" in words and b"serve(*sys.argv" in words:
                os.kill(int(entry.name), signal.SIGKILL)


@pytest.mark.parametrize("focus", ["#slide", "#shape", "#flatten", ".qhm-surface", "input[name=colouring]:checked"])
def test_undo_works_whatever_has_the_focus(served_parts, opened, settled, focus):
    page = opened(served_parts)
    act(page, settled, lambda: page.click("#flatten"))
    page.focus(focus)
    act(page, settled, lambda: page.keyboard.press("Control+z"))
    assert page.is_disabled("#undo")
    act(page, settled, lambda: page.keyboard.press("Control+Shift+z"))
    assert page.is_disabled("#redo")


def test_undo_in_a_text_field_changes_only_the_text(served_parts, opened, settled):
    page = opened(served_parts)
    act(page, settled, lambda: page.click("#flatten"))
    page.select_option("#shape", "letter")
    page.fill("#letter", "Q")
    page.press("#letter", "Control+z")
    page.wait_for_timeout(300)
    assert not page.is_disabled("#undo")


def click_on_surface(page, vertex):
    x, y = page.evaluate("v => studio.view.hands.space().project(v)", vertex)
    box = page.locator("#view").bounding_box()
    page.mouse.click(box["x"] + x, box["y"] + y)


def test_seams_are_drawn_on_the_surface_and_erased(opened, settled, address):
    page = opened(address)
    # Two boundary vertices of the cat that face the viewer.
    positions = np.array(page.evaluate("Array.from(studio.view.hands.space().positions)")).reshape(-1, 3)
    front = np.flatnonzero(positions[:, 2] > np.quantile(positions[:, 2], 0.8))
    left, right = front[np.argmin(positions[front, 0])], front[np.argmax(positions[front, 0])]
    page.keyboard.press("s")
    assert page.is_checked("input[value=seam]")
    click_on_surface(page, int(left))
    act(page, settled, lambda: click_on_surface(page, int(right)))
    assert "seams have changed" in page.inner_text("#hint") or page.is_checked("input[value=seam]")
    page.keyboard.press("Escape")
    page.keyboard.press("v")
    assert "The seams have changed" in page.inner_text("#hint")
    act(page, settled, lambda: page.click("#flatten"))
    assert "--seams seams.txt" in page.inner_text("#command")
    assert "no inverted triangle, no overlap" in page.inner_text("#verdict")
    act(page, settled, lambda: page.keyboard.press("Control+z"))
    page.keyboard.press("e")
    act(page, settled, lambda: click_on_surface(page, int(left)))
    page.keyboard.press("v")
    act(page, settled, lambda: page.click("#flatten"))
    assert page.is_hidden("#islands")


def test_a_model_that_is_inside_out_is_turned(served_parts, opened, settled, models):
    page = opened(served_parts)
    act(page, settled, lambda: page.set_input_files("#open", models["inward"]))
    act(page, settled, lambda: page.click("#turn"))
    assert page.is_hidden("#outward")
    assert "no inverted triangle" in page.inner_text("#verdict")


def test_a_corner_dragged_across_the_opposite_side_is_explained_with_an_undo(address, opened, settled):
    page = opened(address)
    x, y = page.evaluate("studio.view.hands.plane.pointOf(...studio.view.scene.placeOf(studio.view.scene.corners[2]))")
    far = page.evaluate("studio.view.hands.plane.pointOf(...studio.view.scene.placeOf(studio.view.scene.corners[0]))")
    box = page.locator("#view").bounding_box()
    page.evaluate("document.body.dataset.state = 'asked'")
    page.mouse.move(box["x"] + x, box["y"] + y)
    page.mouse.down()
    for k in range(1, 13):
        at = x + (far[0] - 150 - x) * k / 12, y + (far[1] + 150 - y) * k / 12
        page.mouse.move(box["x"] + at[0], box["y"] + at[1])
        page.wait_for_timeout(30)
    page.mouse.up()
    settled(page)
    words = page.inner_text("#why")
    assert "dragged across" in words
    assert "winding" not in words
    act(page, settled, lambda: page.click("#why button.primary"))
    assert page.is_hidden("#why")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_the_layout_fits_with_large_targets_and_without_serious_findings(served_parts, browser, size, scheme):
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, color_scheme=scheme, bypass_csp=True, has_touch=size[0] < 500
    )
    page = context.new_page()
    page.goto(served_parts)
    page.wait_for_selector("body[data-state=settled]")
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    small = page.evaluate("""() => [
        ...document.querySelectorAll("button, select, .button, #tools label, .segments label, .check")]
      .map((one) => [one.id || one.textContent.trim(), one.getBoundingClientRect()])
      .filter(([, box]) => box.height && (box.height < 31.5 || box.width < 31.5)).map(([name]) => name)""")
    assert small == []
    ground = page.evaluate("getComputedStyle(document.querySelector('aside')).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 200) == (scheme == "dark")
    if AXE is not None:
        page.add_script_tag(path=AXE)
        found = page.evaluate("axe.run().then((found) => found.violations)")
        serious = [
            (one["id"], [node["target"] for node in one["nodes"]])
            for one in found
            if one["impact"] in ("serious", "critical")
        ]
        assert serious == []
    context.close()


def test_the_list_of_keys(served_parts, opened):
    page = opened(served_parts)
    page.keyboard.press("?")
    assert "undo, redo" in page.inner_text("#keys")
    page.keyboard.press("Escape")
    assert page.is_hidden("#keys")
    for key, tool in (("p", "pin"), ("c", "corner"), ("d", "draw"), ("v", "move")):
        page.keyboard.press(key)
        assert page.is_checked(f"input[value={tool}]")


def test_every_control_is_reached_by_the_keyboard(served_parts, opened):
    page = opened(served_parts)
    seen = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        seen.add(
            page.evaluate(
                "document.activeElement.id || document.activeElement.className || document.activeElement.value"
            )
        )
    panes = {"qhm-pane qhm-surface", "qhm-pane qhm-map"}
    controls = {"fit", "help", "move", "unwrap", "flatten", "pack", "shape", "save", "glb", "polish", "command"}
    assert panes | controls <= seen


def test_two_fingers_zoom_and_one_drags(served_parts, browser):
    context = browser.new_context(viewport={"width": 390, "height": 800}, has_touch=True)
    page = context.new_page()
    page.goto(served_parts)
    page.wait_for_selector("body[data-state=settled]")
    box = page.locator(".qhm-surface").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    touch = page.context.new_cdp_session(page)

    def send(kind, *points):
        touch.send(
            "Input.dispatchTouchEvent",
            {"type": kind, "touchPoints": [{"x": a, "y": b, "id": i} for i, (a, b) in enumerate(points)]},
        )

    zoom = page.evaluate("studio.view.hands.space().zoom")
    send("touchStart", (x - 20, y), (x + 20, y))
    for k in range(1, 6):
        send("touchMove", (x - 20 - 8 * k, y), (x + 20 + 8 * k, y))
    send("touchEnd")
    assert page.evaluate("studio.view.hands.space().zoom") > 2 * zoom
    send("touchStart", (x, y))
    send("touchMove", (x + 40, y))
    send("touchEnd")
    assert page.evaluate("studio.view.hands.space().yaw") > 0.2
    # Three fingers do not move an island of the map.
    x, y = page.evaluate(
        """() => {
      const { scene, hands } = studio.view;
      const [a, b, c] = [0, 1, 2].map((k) => scene.placeOf(scene.triangles[300 + k]));
      return hands.plane.pointOf((a[0] + b[0] + c[0]) / 3, (a[1] + b[1] + c[1]) / 3);
    }"""
    )
    box = page.locator("#view").bounding_box()
    fingers = [(box["x"] + x, box["y"] + y), (box["x"] + x + 2, box["y"] + y), (box["x"] + x, box["y"] + y + 2)]
    page.evaluate("() => { window.sent = []; studio.view.hands.send = (message) => window.sent.push(message.do); }")
    for count in (1, 2, 3):
        send("touchStart", *fingers[:count])
    for k in range(1, 6):
        send("touchMove", *((a, b + 6 * k) for a, b in fingers))
    for count in (2, 1, 0):
        send("touchEnd", *fingers[:count])
    assert page.evaluate("sent") == []
    context.close()


def test_handles_behind_the_surface_are_faded_and_not_those_in_front(address, opened):
    page = opened(address)
    hidden = """() => {
      const { scene, hands } = studio.view;
      const hidden = [...hands.space().hidden(scene.corners, scene.triangles)];
      return hidden.map((vertex) => scene.corners.indexOf(vertex)).sort();
    }"""
    assert page.evaluate(hidden) == [2, 3], "the corners behind the ears"
    page.evaluate("studio.view.hands.space().turnBy(Math.PI * 100, 0)")
    assert not {2, 3} & set(page.evaluate(hidden))
