"""A studio server in a thread, and the sockets of its pages."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import threading
import time

import psutil
import pytest

pytest.importorskip("websockets", reason="the extra studio is not installed")

from websockets.sync.client import connect

from quasiharmonic.surfaces import cat
from quasiharmonic.ui.studio import server as served
from quasiharmonic.ui.studio.protocol import decode


class Running:
    """Run a server in a thread."""

    def __init__(self, source):
        self.source = source

    def __enter__(self):
        self.studio = served.Studio(self.source)
        ready = threading.Event()
        self.loop = asyncio.new_event_loop()
        self.task = self.loop.create_task(self.studio.run(0, lambda address: ready.set()))
        self.thread = threading.Thread(target=self._run)
        self.thread.start()
        assert ready.wait(30)
        return self

    def _run(self):
        with contextlib.suppress(asyncio.CancelledError):
            self.loop.run_until_complete(self.task)
        self.loop.close()

    def __exit__(self, *error):
        self.loop.call_soon_threadsafe(self.task.cancel)
        self.thread.join(30)

    def get(self, path, **headers):
        """Return status, headers and content of a response."""
        connection = http.client.HTTPConnection("127.0.0.1", self.studio.port, timeout=10)
        connection.putrequest("GET", path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, dict(answer.getheaders()), content

    def page(self, **options):
        """Open a socket as the page's own script does."""
        at = f"127.0.0.1:{self.studio.port}"
        options = {"origin": f"http://{at}", "token": self.studio.token, "max_size": None, **options}
        return connect(f"ws://{at}/{options.pop('token')}/socket", compression=None, **options)


def hear(socket, kind, *, state=None, seconds=60):
    """Return the next frame of a kind."""
    until = time.monotonic() + seconds
    while True:
        frame = decode(socket.recv(timeout=until - time.monotonic()))
        if frame.header["kind"] == kind and state in (None, frame.header.get("state")):
            return frame


def session_page(running, name):
    """Open a socket with the name of a session, as a page does after a reload."""
    at = f"127.0.0.1:{running.studio.port}"
    address = f"ws://{at}/{running.studio.token}/socket?session={name}"
    return connect(address, compression=None, origin=f"http://{at}", max_size=None)


@contextlib.contextmanager
def serve_small_surface(folder):
    """Run a server of a small surface, which takes few bytes."""
    source = folder / "small.obj"
    V, F = cat(8)
    lines = [*(f"v {x!r} {y!r} {z!r}" for x, y, z in V.tolist()), *(f"f {a} {b} {c}" for a, b, c in (F + 1).tolist())]
    source.write_text("\n".join(lines) + "\n")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(served, "MAX_BYTES", 4 << 20)
        with Running(str(source)) as server:
            yield server


def children():
    """Return processes of pages."""
    found = []
    for process in psutil.Process().children():
        with contextlib.suppress(psutil.Error):
            if "quasiharmonic.ui.studio.page_worker" in " ".join(process.cmdline()):
                found.append(process)
    return found


def nobody_is_left():
    """Wait until no page process is left."""
    until = time.monotonic() + 20
    while children() and time.monotonic() < until:
        time.sleep(0.05)
    assert children() == []
