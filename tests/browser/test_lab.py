"""The widget in JupyterLab: a drag in the cell moves the map in the kernel."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress

import pytest

from quasiharmonic.io import checkerboard, own_texture, read_mesh

sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed (.ci/browser does it)")

CELLS = [
    """from quasiharmonic import Problem
from quasiharmonic.surfaces import cat
from quasiharmonic.targets import boundary_to
from quasiharmonic.ui.notebook import MapWidget

V, F = cat(10)
view = MapWidget(Problem(V, F, *boundary_to(V, F, "rect:1x1")))
before = view.result.uv
view""",
    'print("moved", abs(view.result.uv - before).max().round(3), view.result.certificate.bijective)',
    """import numpy as np
H = np.concatenate([F, F + len(V)])
two = MapWidget(np.concatenate([V, V + 3]), H)
counts = []
two.observe(lambda change: counts.append(change.new), "revision")
two""",
    'print("state", two.selected, len(two.image.data), len(counts), len(two.mesh.islands))',
]


@pytest.fixture
def lab(tmp_path):
    """Return the address of a JupyterLab with a notebook."""
    pytest.importorskip("jupyterlab")
    cells = [
        {"cell_type": "code", "source": text, "metadata": {}, "outputs": [], "execution_count": None, "id": f"c{k}"}
        for k, text in enumerate(CELLS)
    ]
    notebook = {"cells": cells, "metadata": {"kernelspec": {"name": "python3", "display_name": "Python 3"}}}
    (tmp_path / "drag.ipynb").write_text(json.dumps({**notebook, "nbformat": 4, "nbformat_minor": 5}))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", f"--port={port}", "--ip=127.0.0.1"]
    command += ["--IdentityProvider.token=", "--ServerApp.open_browser=False", f"--ServerApp.root_dir={tmp_path}"]
    home = {**os.environ, "JUPYTER_CONFIG_DIR": str(tmp_path / "config"), "JUPYTER_DATA_DIR": str(tmp_path / "data")}
    with subprocess.Popen(command, env=home, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        address = f"http://127.0.0.1:{port}"
        try:
            for _ in range(300):
                with suppress(OSError):
                    urllib.request.urlopen(f"{address}/api", timeout=5)
                    break
                time.sleep(0.2)
            yield f"{address}/lab/tree/drag.ipynb"
        finally:
            server.kill()


@pytest.mark.long
def test_a_drag_in_jupyterlab_moves_the_map_of_the_kernel(browser, lab, tmp_path):
    page = browser.new_page(viewport={"width": 1200, "height": 900})
    page.set_default_timeout(60_000)
    # JupyterLab may ask at any time, such as for a kernel while its server is slow: its own choice will do.
    dialog = page.locator(".jp-Dialog")
    page.add_locator_handler(dialog, lambda: dialog.locator("button.jp-mod-accept").first.click())
    page.goto(lab, wait_until="commit")
    page.locator(".jp-Notebook-ExecutionIndicator[data-status=idle]").first.wait_for()
    for _ in range(5):  # a cell that is run before the kernel is ready may be forgotten
        page.locator(".jp-CodeCell .cm-content").first.click()
        page.keyboard.press("Shift+Enter")
        with suppress(sync_api.TimeoutError):
            page.locator("div[role=status]", has_text="Bijective").first.wait_for(timeout=15_000)
            break
    box = page.locator(".qhm-map").bounding_box()
    x, y = box["x"] + box["width"] / 2 - 0.42 * min(box["width"], box["height"]), box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(x + 5 * step, y)
        page.wait_for_timeout(100)
    page.mouse.up()
    page.wait_for_timeout(2000)
    page.locator(".jp-CodeCell").nth(1).locator(".cm-content").click()
    page.keyboard.press("Shift+Enter")
    said = page.locator(".jp-OutputArea-output", has_text="moved").inner_text().split()
    assert float(said[1]) > 0.05
    assert said[2] == "True"
    # Keys in the view do not go to the notebook, where A and B insert cells.
    cells = page.locator(".jp-CodeCell").count()
    page.locator(".qhm-map").focus()
    for key in ("b", "a", "ArrowRight"):
        page.keyboard.press(key)
    page.wait_for_timeout(300)
    assert page.locator(".jp-CodeCell").count() == cells
    use_image_islands_and_export(page, tmp_path)
    page.close()


def use_image_islands_and_export(page, folder):
    """Select an island, show an image and save it in the second widget; the kernel follows."""
    page.locator(".jp-CodeCell").nth(2).locator(".cm-content").click()
    page.keyboard.press("Shift+Enter")
    view = page.locator(".jp-CodeCell").nth(2)
    view.get_by_role("button", name="1: 600").click()
    view.locator("button[data-island='0'][aria-pressed=false]").wait_for()
    assert view.locator("button[data-island='1'][aria-pressed=true]").count() == 1
    (folder / "board.png").write_bytes(checkerboard().data)
    view.locator("input[type=file]").set_input_files(folder / "board.png")
    sync_api.expect(view.locator("select")).to_have_value("image", timeout=30_000)
    with page.expect_download() as download:
        view.get_by_role("button", name="Save GLB").click()
    download.value.save_as(folder / "map.glb")
    assert own_texture(read_mesh(folder / "map.glb")).data == checkerboard().data
    page.locator(".jp-CodeCell").nth(3).locator(".cm-content").click()
    page.keyboard.press("Shift+Enter")
    said = page.locator(".jp-OutputArea-output", has_text="state").inner_text().split()
    assert said == ["state", "[1]", str(len(checkerboard().data)), "2", "2"]
