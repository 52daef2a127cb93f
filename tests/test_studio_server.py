"""The studio server: access control, and independence of pages."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields

import numpy as np
import psutil
import pytest

pytest.importorskip("websockets", reason="the extra studio is not installed")

from websockets.exceptions import ConnectionClosed, InvalidStatus

from quasiharmonic.ui.cli import main
from quasiharmonic.ui.studio import page_worker
from quasiharmonic.ui.studio import server as served
from quasiharmonic.ui.studio.page import assets, bundle
from quasiharmonic.ui.studio.protocol import decode, encode
from quasiharmonic.util.options import ENERGIES, UnwrapOptions
from shared.studio_server import Running, children, hear, nobody_is_left


def test_files_are_served_only_with_the_token(running):
    token = running.studio.token
    status, headers, content = running.get(f"/{token}/")
    assert status == 200
    assert b"qhm studio" in content
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Server" not in headers
    for name in assets():
        assert running.get(f"/{token}/{name}")[0] == 200
    status, headers, _ = running.get(f"/{token}")
    assert (status, headers["Location"]) == (308, f"/{token}/")
    for path in ("/", "/index.html", f"/{token[:-1]}/", f"/{token}x/", f"/x/{token}/", f"//{token}/"):
        status, _, content = running.get(path)
        assert status == 403
        assert b"token" in content
        assert token.encode() not in content


def test_the_page_offers_the_energies_and_options_of_the_library(running):
    with running.page() as socket:
        hello = decode(socket.recv(timeout=30)).header
    assert tuple(hello["energies"]) == ENERGIES
    known = {one.name: one for one in fields(UnwrapOptions)}
    for one in hello["options"]:
        assert one["default"] == known[one["name"]].default
        assert one["help"]
        assert f"{one['name']}: '" in assets()["options.js"].content.decode(), "a picture"


@pytest.mark.parametrize(
    "name",
    ["../server.py", "..%2fserver.py", "static/view.js", "%2e%2e/server.py", "/etc/passwd", "view.js%00", "x"],
)
def test_files_of_the_server_cannot_be_read(running, name):
    assert running.get(f"/{running.studio.token}/{name}")[0] == 404


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1", ""])
def test_a_foreign_host_is_rejected(running, host):
    status, _, content = running.get(f"/{running.studio.token}/", Host=host)
    assert status == 421
    assert b"studio" not in content


@pytest.mark.parametrize(
    "options", [{"origin": "http://evil.example"}, {"origin": None}, {"token": "wrong"}, {"origin": "null"}]
)
def test_a_socket_of_another_site_is_rejected(running, options):
    with pytest.raises(InvalidStatus) as refused, running.page(**options):
        pass
    assert refused.value.response.status_code == 403


@pytest.mark.long
def test_pages_are_independent_and_a_crash_ends_only_its_page(running):
    with running.page() as one, running.page() as other:
        for socket in (one, other):
            hear(socket, "map", state="settled")
        one.send(encode({"do": "outline", "to": "disk"}))
        assert hear(one, "map", state="settled").header["outline"] == "disk"
        other.send(encode({"do": "undo"}))
        assert hear(other, "map", state="settled").header["outline"] == "rect:1x1"
        min(children(), key=psutil.Process.create_time).kill()
        assert "the process of this page has ended" in hear(one, "note").header["text"]
        with pytest.raises(ConnectionClosed):
            hear(one, "map")
        other.send(encode({"do": "outline", "to": "disk"}))
        assert hear(other, "map", state="settled").header["injective"]
    nobody_is_left()


@pytest.mark.slow
def test_a_socket_closed_during_a_drag_leaves_no_process(running):
    with running.page() as page:
        shown = hear(page, "map", state="settled").header
        page.send(encode({"do": "grab", "vertex": shown["corners"][0]}))
        for seq in range(20):
            page.send(encode({"do": "drag", "seq": seq, "to": [-0.01 * seq, 0.0]}))
        page.socket.close()
    nobody_is_left()


@pytest.mark.long
def test_messages_that_are_too_large_or_invalid_close_only_their_page(running):
    with running.page() as other:
        hear(other, "map", state="settled")
        with running.page() as page:
            page.send("words")
            with pytest.raises(ConnectionClosed) as closed:
                hear(page, "never")
            assert closed.value.rcvd.code == 1003
        with running.page() as page:
            page.send(b"\xff" * 40)
            with pytest.raises(ConnectionClosed) as closed:
                hear(page, "never")
            assert closed.value.rcvd.code == 1007
        with running.page() as page:
            with contextlib.suppress(ConnectionClosed):
                page.send(bytes(served.MAX_BYTES + (2 << 20)))
            with pytest.raises(ConnectionClosed) as closed:
                hear(page, "never")
            assert closed.value.rcvd.code == 1009
        other.send(encode({"do": "undo"}))
        assert hear(other, "map").header["injective"]


@pytest.mark.long
def test_the_number_of_pages_is_limited(running, monkeypatch):
    nobody_is_left()
    time.sleep(0.2)
    monkeypatch.setattr(served, "MAX_PAGES", 1)
    with running.page() as page:
        hear(page, "hello")
        time.sleep(0.2)
        with running.page() as one_more, pytest.raises(ConnectionClosed) as refused:
            hear(one_more, "hello")
        assert refused.value.rcvd.code == served.TRY_LATER
        assert refused.value.rcvd.reason == "1 pages are open, which is the maximum"


def test_the_view_is_available_as_one_module():
    text = bundle("view")
    assert 'from "./' not in text
    assert text.rstrip().endswith("export const { createView } = qhm_view;")
    for name in ("frames", "hands", "overlay", "plane", "shaders", "space"):
        assert text.count(f"const qhm_{name} = ") == 1
    with pytest.raises(KeyError):
        bundle("nothing")


def test_without_websockets_the_command_names_the_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    monkeypatch.delitem(sys.modules, "quasiharmonic.ui.studio.server")
    assert main(["studio", "--no-browser"]) == 2
    assert "[studio]'" in capsys.readouterr().err


def test_an_invalid_mesh_file_is_rejected_before_the_server_starts(tmp_path, capsys):
    (tmp_path / "a.obj").write_text("v 0 0 0\nf 1 2 3\n")
    assert main(["studio", str(tmp_path / "a.obj"), "--no-browser"]) == 2
    assert "a.obj" in capsys.readouterr().err


# --- many pages at once, and endless messages -------------------------------------------------------------------------


class Stuck:
    """A page whose process starts late, takes no message, and ends on request."""

    started = 0
    begins: asyncio.Event
    ends: asyncio.Event

    @classmethod
    async def start(cls, source, tell, folder):
        cls.started += 1
        await cls.begins.wait()
        return cls()

    async def send(self, message, *, stops=False):
        await asyncio.Event().wait()

    async def run(self):
        await self.ends.wait()
        return "it has ended"

    def end(self):
        self.ends.set()

    async def wait_for_end(self):
        pass


@pytest.fixture
def stuck(monkeypatch):
    monkeypatch.setattr(served, "PageProcess", Stuck)
    monkeypatch.setattr(served, "MAX_BYTES", 32 << 20)
    Stuck.started, Stuck.begins, Stuck.ends = 0, asyncio.Event(), asyncio.Event()
    with Running("") as server:
        yield server
        for event in (Stuck.begins, Stuck.ends):
            server.loop.call_soon_threadsafe(event.set)


def first_word(page):
    """Return what a page receives first: a greeting, or a reason why it is closed."""
    try:
        return decode(page.recv(timeout=10)).header["kind"]
    except ConnectionClosed as closed:
        return closed.rcvd.code


@pytest.mark.slow
def test_pages_opened_at_once_count_like_pages_opened_one_by_one(stuck):
    with contextlib.ExitStack() as opened, ThreadPoolExecutor(20) as threads:
        pages = [opened.enter_context(page) for page in threads.map(lambda _: stuck.page(), range(20))]
        words = list(threads.map(first_word, pages))
        assert words.count("hello") == served.MAX_PAGES
        assert words.count(served.TRY_LATER) == 20 - served.MAX_PAGES
        assert Stuck.started == served.MAX_PAGES
        for event in (Stuck.begins, Stuck.ends):
            stuck.loop.call_soon_threadsafe(event.set)
        for page in pages:
            with contextlib.suppress(ConnectionClosed):
                hear(page, "never")
    time.sleep(0.1)
    with stuck.page() as page:
        assert first_word(page) == "hello"


def test_a_page_whose_process_cannot_start_gets_the_reason(running, monkeypatch, capfd):
    def start(source, tell, folder):
        raise OSError(11, "no more processes")

    monkeypatch.setattr(served.PageProcess, "start", start)
    with running.page() as page:
        assert "no more processes" in hear(page, "note").header["text"]
        assert first_word(page) == served.TRY_LATER
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_unprocessed_messages_are_not_read(stuck):
    """Two of them wait in the server, and one or two more on the way; the page keeps the others."""
    message = encode({"do": "load"}, {"content": np.zeros(16 << 20, dtype=np.uint8)})
    sent = []

    def flood(page):
        with contextlib.suppress(ConnectionClosed):
            for number in range(12):
                page.send(message)
                sent.append(number)

    stuck.loop.call_soon_threadsafe(Stuck.begins.set)
    with stuck.page() as page:
        hear(page, "hello")
        thread = threading.Thread(target=flood, args=(page,))
        thread.start()
        thread.join(1)
        assert thread.is_alive()
        assert len(sent) <= 4
        page.socket.shutdown(socket.SHUT_RDWR)
        thread.join(10)


class Endless:
    """An endless file of equal messages."""

    def __init__(self, message):
        self.message, self.messages, self.head = message, 0, False

    def read(self, count):
        self.head = not self.head
        if self.head:
            return len(self.message).to_bytes(8, "little")
        self.messages += 1
        return self.message


def test_a_process_reads_no_more_than_its_queue_holds(monkeypatch):
    monkeypatch.setattr(page_worker, "MAX_WAITING", 1 << 20)
    source = Endless(encode({"do": "load"}, {"content": np.zeros(1 << 18, dtype=np.uint8)}))
    inbox = page_worker.Inbox(source)
    for taken in range(1, 20):
        inbox.take()
        time.sleep(0.002)
        # Three wait, and the next is being read.
        assert source.messages <= taken + 4
    assert inbox.waiting()
