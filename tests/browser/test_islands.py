"""Islands on the page: grabbed anywhere, selected by a box and in both views, scaled, welded, stitched, repaired."""

from __future__ import annotations

import numpy as np
import pytest

from quasiharmonic import io
from quasiharmonic.surfaces import grid

# Positions in the map, with the origin of the view.
PLACES = "Array.from(studio.view.scene.places, (value, i) => value + studio.view.scene.origin[i % 2])"


def sheets(gap, inverted):
    """Return a sheet of 6 by 4 squares as two halves, the right one moved, perhaps with an inverted triangle."""
    V, F = grid(6, 4)
    right = V[F].mean(axis=1)[:, 0] > V[:, 0].mean()
    uv = np.concatenate([V, V + np.array([gap, 0])])
    if inverted:
        inner = np.argmin(np.linalg.norm(V - [V[:, 0].max() / 4, V[:, 1].mean()], axis=1))
        uv[inner] += [0, 0.6 * V[:, 1].max()]
    V = np.column_stack([V, 0.1 * np.sin(5 * V[:, 0])])
    return io.MeshData(V, F, vt=uv, FT=F + len(V) * right[:, None])


@pytest.fixture(scope="module")
def halves(serving_of_module, tmp_path_factory):
    """Addresses of pages: with two islands, and with an inverted triangle as well."""
    folder = tmp_path_factory.mktemp("islands")
    for name, gap, inverted in (("sound", 0.5, False), ("wrong", 0.5, True)):
        io.write_mapped(folder / f"{name}.obj", sheets(gap, inverted))
    with serving_of_module(folder / "sound.obj") as sound, serving_of_module(folder / "wrong.obj") as wrong:
        yield {"sound": sound, "wrong": wrong}


def act(page, settled, do):
    """Do something and wait for the resulting map."""
    page.evaluate("document.body.dataset.state = 'asked'")
    do()
    settled(page)


def places(page):
    return np.array(page.evaluate(PLACES)).reshape(-1, 2)


def on_screen(page, triangle):
    """Return the screen position of the middle of a triangle of the map."""
    x, y = page.evaluate(
        """(t) => {
      const { scene, hands } = studio.view;
      const corners = [0, 1, 2].map((k) => scene.placeOf(scene.triangles[3 * t + k]));
      return hands.plane.pointOf(...[0, 1].map((i) => (corners[0][i] + corners[1][i] + corners[2][i]) / 3));
    }""",
        triangle,
    )
    box = page.locator("#view").bounding_box()
    return box["x"] + x, box["y"] + y


def drag(page, start, by):
    page.mouse.move(*start)
    page.mouse.down()
    for k in range(1, 6):
        page.mouse.move(start[0] + by[0] * k / 5, start[1] + by[1] * k / 5)
    page.mouse.up()


def test_an_island_is_grabbed_anywhere_inside_without_a_selection(halves, opened, settled):
    page = opened(halves["sound"])
    before, second = places(page), page.evaluate("studio.view.scene.starts[1]")
    assert page.evaluate("studio.view.scene.selected.size") == 2
    inner = page.evaluate("studio.view.scene.firstTriangles[1]") + 10
    act(page, settled, lambda: drag(page, on_screen(page, inner), (30, 0)))
    moved = places(page) - before
    assert np.allclose(moved[:second], 0, atol=1e-5)
    assert np.allclose(moved[second:, 0], 30 / page.evaluate("studio.view.hands.plane.pixels"), atol=1e-3)
    assert page.evaluate("[...studio.view.scene.selected]") == [1]
    assert page.locator("#islands [aria-pressed=true]").count() == 1


def test_a_box_selects_islands_and_the_others_are_paler_in_both_views(halves, opened, settled):
    page = opened(halves["sound"])
    colours = """() => {
      const canvas = studio.view.picture(), context = canvas.getContext("2d");
      return [0.12, 0.38].map((x) => Array.from(
        context.getImageData(canvas.width * x, canvas.height / 2 - 20, 1, 40).data));
    }"""
    before = page.evaluate(colours)
    x, y = on_screen(page, 0)
    box = page.locator(".qhm-map").bounding_box()
    page.keyboard.down("Shift")
    corner = box["x"] + 4, box["y"] + box["height"] - 4
    act(page, settled, lambda: drag(page, corner, (x + 4 - corner[0], y - 4 - corner[1])))
    page.keyboard.up("Shift")
    assert page.evaluate("[...studio.view.scene.selected]") == [0]
    page.wait_for_timeout(300)
    changed = [not np.array_equal(one, other) for one, other in zip(before, page.evaluate(colours), strict=True)]
    assert changed == [False, True], "the half on the right of the surface is not selected"
    assert page.evaluate("studio.view.scene.frame") is None


def test_islands_are_scaled_mirrored_snapped_and_welded_by_buttons(halves, opened, settled):
    page = opened(halves["sound"])
    act(page, settled, lambda: page.locator("#islands button").first.click())
    before, second = places(page), page.evaluate("studio.view.scene.starts[1]")
    act(page, settled, lambda: page.click("#smaller"))
    assert np.ptp(places(page)[:second], axis=0) == pytest.approx(0.9 * np.ptp(before[:second], axis=0), rel=1e-4)
    worst = page.inner_text("#worst")
    act(page, settled, lambda: page.click("#mirror"))
    assert "no inverted triangle" in page.inner_text("#verdict")
    assert page.inner_text("#worst") == worst
    for _ in range(2):
        act(page, settled, lambda: page.keyboard.press("Control+z"))
    page.check("#snap")
    page.click("#weld")
    page.wait_for_selector("#note:not([hidden])")
    assert "closer than a texel" in page.inner_text("#note-text")


def test_an_error_disappears_after_the_next_action_that_succeeds(halves, opened, settled):
    page = opened(halves["sound"])
    page.click("#weld")
    page.wait_for_selector("#note:not([hidden])")
    act(page, settled, lambda: page.locator("#islands button").first.click())
    assert page.is_hidden("#note")


def test_empty_and_long_fields(halves, opened, settled):
    page = opened(halves["sound"])
    page.click("summary")
    page.fill("#padding", "")
    act(page, settled, lambda: page.click("#pack"))
    assert "--padding 4" in page.inner_text("#command")
    page.select_option("#shape", "letter")
    for typed, kept in [("AB", "A"), ("\U0001d538", "\U0001d538"), ("e\u0301", "é"), (" ", "")]:
        page.fill("#letter", typed)
        assert page.input_value("#letter") == kept
    page.click("#outline button")
    page.wait_for_selector("#note:not([hidden])")
    assert page.inner_text("#note-text") == "Type a letter first."


def test_the_only_island_is_mirrored_and_reflected_again(address, opened, settled):
    page = opened(address)
    energy = page.inner_text("#energy")
    act(page, settled, lambda: page.click("#mirror"))
    assert page.inner_text("#title") == "Mirrored"
    assert "Mirror or Repair reflects the map" in page.inner_text("#words")
    act(page, settled, lambda: page.click("#repair"))
    assert "no inverted triangle" in page.inner_text("#verdict")
    assert page.inner_text("#energy") == energy


def test_energies_have_few_digits(address, opened):
    page = opened(address)
    for energy, words in [(7.7351e-12, "7.74e-12"), (0, "0"), (0.12345, "0.1235"), (2e7, "2.00e+7")]:
        page.evaluate("energy => studio.panel.status.map({ ...studio.panel.status.header, energy }, true, 0)", energy)
        assert page.inner_text("#energy") == words


def test_stitch_joins_the_islands_at_a_seam(halves, opened, settled):
    page = opened(halves["sound"])
    page.keyboard.press("t")
    assert page.is_checked("input[value=stitch]")
    box = page.locator(".qhm-surface").bounding_box()
    act(page, settled, lambda: page.mouse.click(box["x"] + box["width"] / 2 + 3, box["y"] + box["height"] / 2))
    assert page.is_hidden("#islands")
    assert "no inverted triangle, no overlap" in page.inner_text("#verdict")


def test_a_map_with_inverted_triangles_is_repaired_beside_its_verdict(halves, opened, settled):
    page = opened(halves["wrong"])
    assert "Not injective" in page.inner_text("#verdict")
    assert int(page.inner_text("#flips")) == page.evaluate("studio.view.scene.bad.length") > 0
    assert page.inner_text("#command") == "The map is the one in the file."
    act(page, settled, lambda: page.click("#verdict #repair"))
    assert "Certified: no inverted triangle" in page.inner_text("#verdict")
    assert page.is_hidden("#repair")
    assert page.inner_text("#command").startswith("qhm repair wrong.obj")


def test_views_from_the_front_the_side_and_the_top(halves, opened):
    page = opened(halves["sound"])
    axes = "studio.view.hands.space().axes[2].map((value) => Math.round(value) + 0)"
    page.click("[data-view=side]")
    assert page.evaluate(axes) == [1, 0, 0]
    page.locator(".qhm-surface").focus()
    page.keyboard.press("7")
    assert page.evaluate(axes) == [0, 1, 0]
    page.keyboard.press("1")
    assert page.evaluate(axes) == [0, 0, 1]


def test_options_of_unwrap_have_pictures_and_reach_the_library(halves, opened, settled):
    page = opened(halves["sound"])
    page.click("summary")
    fields = page.locator("#unwrap-options .option")
    assert fields.count() >= 8
    for k in range(fields.count()):
        assert fields.nth(k).locator("svg path, svg circle").count() >= 2
        assert len(fields.nth(k).locator("p").inner_text()) > 20
    page.select_option("#unwrap-symmetry", "none")
    page.fill("#unwrap-hard_edges", "40")
    act(page, settled, lambda: page.click("#unwrap"))
    command = page.inner_text("#command")
    assert "--hard-edges 40" in command
    assert "--symmetry none" in command
    assert "--max-charts" not in command
