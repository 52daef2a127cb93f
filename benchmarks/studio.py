"""How quickly the page follows a hand: maps a second, and milliseconds from the mouse to the picture, in a browser.

    pip install '.[studio]' playwright
    python benchmarks/studio.py --triangles 5000 20000 100000

The mouse goes around in a circle with a corner of the square in its hand. A picture counts when all of it is drawn, by
the processor where there is no graphics card, which takes its share of the cores. CPU time is that of the server with
its processes and of the browser with its own, all cores together; the last column is that of a map without a browser, its
exact verdict included. On a busy machine only CPU time says something.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ARGUMENTS = [
    *("--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--triangles", type=int, nargs="+", default=[5_000, 20_000, 100_000])
    parser.add_argument("--seconds", type=float, default=6.0, help="of dragging, for each size (default: 6)")
    parser.add_argument("--window", default="1000x600", help="of the browser (default: 1000x600)")
    parser.add_argument("--chromium", default=shutil.which("chromium"))
    options = parser.parse_args()
    print(
        "| triangles | maps a second | pictures a second | mouse to picture | 95 % | CPU a map: computing | drawing | alone |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for triangles in options.triangles:
        rings = round((triangles / 6) ** 0.5)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "cat.obj"
            write(path, rings)
            maps, pictures, middle, late, computing, drawing = in_browser(path, options)
        print(
            f"| {6 * rings**2:,} | {maps:.0f} | {pictures:.0f} | {middle:.0f} ms | {late:.0f} ms "
            f"| {1e3 * computing:.1f} ms | {1e3 * drawing:.1f} ms | {1e3 * alone(rings):.1f} ms |",
            flush=True,
        )


def write(path, rings):
    """A cat's head as an OBJ without a map."""
    from quasiharmonic.surfaces import cat

    V, F = cat(rings)
    lines = [*(f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()), *(f"f {a} {b} {c}" for a, b, c in (F + 1).tolist())]
    path.write_text("\n".join(lines) + "\n")


def in_browser(path, options):
    """Maps and pictures a second; median and 95th percentile of the latency, ms; CPU seconds a map on both sides."""
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "quasiharmonic", "studio", "--no-browser", str(path)]
    width, height = map(int, options.window.split("x"))
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as server,
        sync_playwright() as play,
    ):
        address = server.stdout.readline().strip()
        browser = play.chromium.launch(executable_path=options.chromium, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(address + "?measured")
        page.wait_for_selector("body[data-state=settled]", timeout=300_000)
        vertex = page.evaluate("studio.view.scene.corners[2]")
        x, y = page.evaluate("v => studio.view.hands.plane.pointOf(...studio.view.scene.placeOf(v))", vertex)
        box = page.locator("#view").bounding_box()
        x, y = x + box["x"], y + box["y"]
        page.mouse.move(x, y)
        page.mouse.down()
        for measured in (False, True):
            page.evaluate("Object.assign(studio.view.clock, { maps: 0, frames: 0, latencies: [] })")
            spent = busy(server.pid), busy(os.getpid()) - busy(server.pid)
            began, k = time.perf_counter(), 0
            while time.perf_counter() - began < (options.seconds if measured else 1.5):
                page.mouse.move(x - 20 + 20 * np.cos(k / 15), y + 20 * np.sin(k / 15))
                k += 1
            took = time.perf_counter() - began
            spent = busy(server.pid) - spent[0], busy(os.getpid()) - busy(server.pid) - spent[1]
            clock = page.evaluate("(({ maps, frames, latencies }) => ({ maps, frames, latencies }))(studio.view.clock)")
        page.mouse.up()
        browser.close()
        server.terminate()
    latencies = np.array(clock["latencies"])
    middle, late = np.percentile(latencies, [50, 95])
    maps = clock["maps"]
    return maps / took, clock["frames"] / took, middle, late, spent[0] / maps, spent[1] / maps


def busy(root):
    """CPU seconds of a process's descendants, and of itself if it is not this one."""
    parents, seconds = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(fields[1])
            seconds[int(entry.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def descends(pid):
        while pid in parents and pid != root:
            pid = parents[pid]
        return pid == root

    return sum(value for pid, value in seconds.items() if descends(pid) and pid != os.getpid())


def alone(rings, count=60):
    """CPU seconds of one map that follows, verdict included."""
    from quasiharmonic.io import MeshData
    from quasiharmonic.studio.following import Follower
    from quasiharmonic.studio.grips import grip
    from quasiharmonic.studio.session import Session
    from quasiharmonic.studio.sheets import sheet_of
    from quasiharmonic.surfaces import cat

    session = Session(lambda header, arrays: None)
    session.open(sheet_of(MeshData(*cat(rings), source="cat.obj"), "cat.obj"))
    moment = session.moment
    problem, corner = moment.problem, moment.corners[2]
    follower = Follower(problem, moment.result.uv, moment.result.certificate)
    share = grip(corner, problem.fixed, problem.target, problem.domain.loops, moment.corners)
    cpus = []
    for k in range(count):
        way = 0.05 * np.array([np.cos(k / 15) - 1, np.sin(k / 15)])
        cpu = time.process_time()
        follower.to(problem.target + share[:, None] * way)
        cpus.append(time.process_time() - cpu)
    return np.median(cpus)


if __name__ == "__main__":
    main()
