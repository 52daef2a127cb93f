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


@pytest.mark.slow
def test_a_drag_in_jupyterlab_moves_the_map_of_the_kernel(browser, lab):
    page = browser.new_page(viewport={"width": 1200, "height": 900})
    page.set_default_timeout(60_000)
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
    page.close()
