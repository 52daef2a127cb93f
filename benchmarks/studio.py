"""Response of the studio page in a browser: maps per second, and milliseconds from mouse event to image.

    pip install '.[studio]' playwright
    python benchmarks/studio.py --triangles 5000 20000 100000

The mouse drags a corner of the square in a circle. An image counts when it is drawn completely. Without a graphics card
the CPU draws it, which uses part of the cores. The last two columns are CPU times, which are meaningful on a busy
machine too: of one updated map with its exact certificate, and of the same with all messages to the page.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from speed import machine

ARGUMENTS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, nargs="+", default=[5_000, 20_000, 100_000])
    parser.add_argument("--seconds", type=float, default=6.0, help="of dragging, for each size (default: 6)")
    parser.add_argument("--window", default="1000x600", help="of the browser (default: 1000x600)")
    parser.add_argument("--chromium", default=shutil.which("chromium"), help="none for CPU time alone")
    options = parser.parse_args()
    heads = "maps per second", "images per second", "mouse to image", "95 %", "CPU per map", "CPU with transfer"
    print(f"{machine()}\n\n| triangles | {' | '.join(heads)} |\n" + "|---" * (1 + len(heads)) + "|")
    for triangles in options.triangles:
        rings = round((triangles / 6) ** 0.5)
        shown = "– | – | – | –"
        if options.chromium:
            maps, pictures, middle, late = in_browser(rings, options)
            shown = f"{maps:.0f} | {pictures:.0f} | {middle:.0f} ms | {late:.0f} ms"
        cpu = f"{1e3 * following(rings):.1f} ms | {1e3 * told(rings):.1f} ms"
        print(f"| {6 * rings**2:,} | {shown} | {cpu} |", flush=True)


def in_browser(rings, options):
    """Return maps and images per second, and the median and the 95th percentile of the latency in milliseconds."""
    from playwright.sync_api import sync_playwright

    width, height = map(int, options.window.split("x"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cat.obj"
        write(path, rings)
        command = [sys.executable, "-m", "quasiharmonic", "studio", "--no-browser", str(path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, sync_playwright() as play:
            browser = play.chromium.launch(executable_path=options.chromium, args=ARGUMENTS)
            page = browser.new_page(viewport={"width": width, "height": height})
            page.goto(server.stdout.readline().strip() + "?measured")
            page.wait_for_selector("body[data-state=settled]", timeout=300_000)
            clock, took = dragged(page, options.seconds)
            browser.close()
            server.terminate()
    return clock["maps"] / took, clock["frames"] / took, *np.percentile(clock["latencies"], [50, 95])


def dragged(page, seconds):
    """Drag a corner in circles for ``seconds`` after a warm-up; return the page's counts."""
    vertex = page.evaluate("studio.view.scene.corners[2]")
    x, y = page.evaluate("v => studio.view.hands.plane.pointOf(...studio.view.scene.placeOf(v))", vertex)
    box = page.locator("#view").bounding_box()
    x, y = x + box["x"], y + box["y"]
    page.mouse.move(x, y)
    page.mouse.down()
    for length in (1.5, seconds):
        page.evaluate("Object.assign(studio.view.clock, { maps: 0, frames: 0, latencies: [] })")
        began, k = time.perf_counter(), 0
        while time.perf_counter() - began < length:
            page.mouse.move(x - 20 + 20 * np.cos(k / 15), y + 20 * np.sin(k / 15))
            k += 1
        took = time.perf_counter() - began
        clock = page.evaluate("(({ maps, frames, latencies }) => ({ maps, frames, latencies }))(studio.view.clock)")
    page.mouse.up()
    return clock, took


def write(path, rings):
    """Write a cat's head as an OBJ file without a map."""
    from quasiharmonic.surfaces import cat

    V, F = cat(rings)
    lines = [*(f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()), *(f"f {a} {b} {c}" for a, b, c in (F + 1).tolist())]
    path.write_text("\n".join(lines) + "\n")


def session_of(rings):
    """Return a session with a cat's head that discards its messages."""
    from quasiharmonic.io import MeshData
    from quasiharmonic.surfaces import cat
    from quasiharmonic.ui.studio.protocol import encode
    from quasiharmonic.ui.studio.session.session import Session
    from quasiharmonic.ui.studio.session.surface import make_sheet

    session = Session(encode)
    session.open(make_sheet(MeshData(*cat(rings), source="cat.obj"), "cat.obj"))
    return session


def following(rings):
    """Return the CPU seconds of one updated map, certificate included."""
    from quasiharmonic.ui.studio.session.drag import Follower, drag_weights

    moment = session_of(rings).state
    problem, corner = moment.problem, moment.corners[2]
    follower = Follower(problem, moment.result.uv, moment.result.certificate)
    share = drag_weights(corner, problem.fixed, problem.target, problem.domain.loops, moment.corners)
    return timed(lambda way: follower.to(problem.target + share[:, None] * way))


def told(rings):
    """Return the CPU seconds of one movement, with the map's figures and the frame sent to the page."""
    from quasiharmonic.ui.studio.protocol import MessageFrame

    session = session_of(rings)
    corner = session.state.corners[2]
    place = session.state.result.uv[corner]
    session.handle(MessageFrame({"do": "grab", "vertex": corner}, {}))
    return timed(lambda way: session.handle(MessageFrame({"do": "drag", "seq": 1, "to": (place + way).tolist()}, {})))


def timed(move, count=60):
    """Return the mean CPU seconds of one of ``count`` movements around a circle."""
    began = time.process_time()
    for k in range(count):
        move(0.05 * np.array([np.cos(k / 15) - 1, np.sin(k / 15)]))
    return (time.process_time() - began) / count


if __name__ == "__main__":
    main()
