"""The widget in a browser. The test plays the notebook: dragging moves the map through the kernel."""

from __future__ import annotations

from base64 import b64decode, b64encode

import numpy as np
import pytest

from quasiharmonic import Problem, certify
from quasiharmonic.surfaces import cat
from quasiharmonic.targets import boundary_to
from quasiharmonic.ui import notebook

# The argument of anywidget's `render`: a model whose messages go to the kernel and back.
PAGE = """<!doctype html><meta charset="utf-8"><div id="cell" style="width: 900px"></div><script type="module">
const listeners = [];
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
const text = (buffer) => btoa(Array.from(new Uint8Array(buffer), (byte) => String.fromCharCode(byte)).join(""));
const model = {
  get: () => 420,
  on: (name, listener) => name === "msg:custom" && listeners.push(listener),
  off: () => listeners.pop(),
  send: async (content, callbacks, buffers) => {
    for (const [message, data] of await window.kernel(text(buffers[0])))
      for (const listener of listeners) listener(message, [new DataView(bytes(data).buffer)]);
  },
};
const { default: widget } = await import("data:text/javascript;base64,CODE");
window.leave = widget.render({ model, el: document.getElementById("cell") });
</script>"""


def test_dragging_in_a_cell_moves_the_map(browser, monkeypatch):
    pytest.importorskip("anywidget")
    sent, listeners = [], []
    monkeypatch.setattr(
        notebook.MapWidget, "send", lambda _, content, buffers: sent.append((content, b64encode(buffers[0]).decode()))
    )
    monkeypatch.setattr(notebook.MapWidget, "on_msg", lambda _, listener: listeners.append(listener))
    V, F = cat(12)
    widget = notebook.MapWidget(Problem(V, F, *boundary_to(V, F, "rect:1x1")))
    before = widget.result.uv

    def kernel(data):
        sent.clear()
        listeners[0](widget, {}, [memoryview(b64decode(data))])
        return list(sent)

    page, wrong = browser.new_page(viewport={"width": 940, "height": 520}), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.expose_function("kernel", kernel)
    page.set_content(PAGE.replace("CODE", b64encode(widget.get_state()["_esm"].encode()).decode()))
    line = page.get_by_role("status")
    line.get_by_text("Bijective").wait_for(timeout=60_000)
    picture = page.screenshot()
    # The square is centred in its pane and has 0.84 of its height; this is the middle of its left side.
    box = page.locator(".qhm-map").bounding_box()
    x, y = box["x"] + box["width"] / 2 - 0.42 * box["height"], box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(x + 6 * step, y)
        page.wait_for_timeout(40)
    page.mouse.up()
    for _ in range(200):
        page.wait_for_timeout(50)
        if widget.result.uv[:, 0].tolist() != before[:, 0].tolist():
            break
    moved = widget.result.uv - before
    assert certify(F, widget.result).bijective
    # Move right by 48 pixels; 0.84 of the pane's height has length one.
    assert moved[:, 0].max() == pytest.approx(48 / (0.84 * box["height"]), rel=0.1)
    assert np.abs(moved[:, 1]).max() < 0.5 * moved[:, 0].max()
    assert page.screenshot() != picture
    page.evaluate("leave()")
    assert page.locator("canvas").count() == 0
    assert wrong == []
    page.close()
