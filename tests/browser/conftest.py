"""A studio server and a browser to open it with: Debian's Chromium, driven by Playwright."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager

import pytest

CHROMIUM = os.environ.get("CHROMIUM") or shutil.which("chromium")
# WebGL runs on the CPU, and the network is not used.
ARGUMENTS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]


@contextmanager
def served(*arguments):
    """Return the address of a page of ``qhm studio``."""
    command = [sys.executable, "-m", "quasiharmonic", "studio", "--no-browser", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            yield server.stdout.readline().strip()
        finally:
            server.terminate()


@pytest.fixture(scope="session")
def browser():
    try:
        from playwright import sync_api as playwright
    except ModuleNotFoundError:
        pytest.skip("Playwright is not installed (.ci/browser does it)")
    if CHROMIUM is None:
        pytest.skip("there is no chromium (.ci/browser installs it)")
    with playwright.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def address(browser, tmp_path_factory):
    """A server of a small surface, so that the browser takes most of the time."""
    from quasiharmonic.surfaces import cat

    V, F = cat(16)
    lines = [*(f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()), *(f"f {a} {b} {c}" for a, b, c in (F + 1).tolist())]
    source = tmp_path_factory.mktemp("studio") / "cat.obj"
    source.write_text("\n".join(lines))
    with served(source) as at:
        yield at


@pytest.fixture
def opened(browser):
    """Open pages, each in a separate context, and fail if one raises an error or uses the network."""
    contexts, wrong = [], []

    def open_page(address, *, settled=True, query=""):
        context = browser.new_context(viewport={"width": 1240, "height": 760}, accept_downloads=True)
        context.set_default_timeout(60_000)
        contexts.append(context)
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("request", lambda request: None if request.url.startswith((address[:16], "blob:", "data:", "ws://127.0.0.1"))
                else wrong.append(request.url))  # fmt: skip
        page.goto(address + query)
        if settled:
            at_rest(page)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert wrong == []


def at_rest(page):
    """Wait until the page shows the final map."""
    page.wait_for_selector("body[data-state=settled]")


@pytest.fixture
def settled():
    return at_rest


@pytest.fixture
def serving():
    return served


@pytest.fixture(scope="module")
def serving_of_module(browser):
    return served
