"""The studio server answers malformed requests with an error and stays available."""

from __future__ import annotations

import contextlib
import socket
import time

import pytest

pytest.importorskip("websockets", reason="the extra studio is not installed")

from quasiharmonic.ui.studio import server as served

UPGRADE = (
    b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
)
SOCKET = b"GET /TOKEN/socket HTTP/1.1\r\nHOSTORIGIN" + UPGRADE + b"\r\n"
# HOST, ORIGIN and TOKEN represent the values of the server's own page; None means a closed connection.
MALFORMED = {
    "brackets": (b"GET //[x HTTP/1.1\r\nHOST\r\n", 403),
    "brackets around the token": (b"GET //[TOKEN/ HTTP/1.1\r\nHOST\r\n", 403),
    "a bracket behind the token": (b"GET /TOKEN/[ HTTP/1.1\r\nHOST\r\n", 404),
    "an address": (b"GET http://[x/ HTTP/1.1\r\nHOST\r\n", 400),
    "a star": (b"GET * HTTP/1.1\r\nHOST\r\n", 400),
    "an empty path": (b"GET  HTTP/1.1\r\nHOST\r\n", 400),
    "NUL": (b"GET /TOKEN/\0 HTTP/1.1\r\nHOST\r\n", 404),
    "NUL for a token": (b"GET /\0/ HTTP/1.1\r\nHOST\r\n", 403),
    "percent": (b"GET /TOKEN/%zz%00%ff HTTP/1.1\r\nHOST\r\n", 404),
    "a long path": (b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\nHOST\r\n", (414, None)),
    "a long header": (b"GET / HTTP/1.1\r\nHOSTX: " + b"a" * 100_000 + b"\r\n\r\n", (431, None)),
    "many headers": (b"GET / HTTP/1.1\r\nHOST" + b"X: a\r\n" * 2000 + b"\r\n", (431, None)),
    "no host": (b"GET / HTTP/1.1\r\n\r\n", 421),
    "two hosts": (b"GET / HTTP/1.1\r\nHOSTHOST\r\n", 421),
    "a host in UTF-8": (b"GET / HTTP/1.1\r\nHost: \xc3\xa9\r\n\r\n", 421),
    "a header in UTF-8": (b"GET / HTTP/1.1\r\nHOSTX: \xc3\xa9\r\n\r\n", 403),
    "POST": (b"POST /TOKEN/ HTTP/1.1\r\nHOST\r\n", (405, None)),
    "PUT for a socket": (SOCKET.replace(b"GET", b"PUT"), (405, None)),
    "no upgrade": (b"GET /TOKEN/socket HTTP/1.1\r\nHOSTORIGIN\r\n", 426),
    "a key in UTF-8": (SOCKET.replace(b"dGh", b"\xff\xff\xff"), 400),
    "a short key": (SOCKET.replace(b"dGhl", b""), 400),
    "another version": (SOCKET.replace(b": 13", b": 99"), 400),
    "an origin in UTF-8": (SOCKET.replace(b"ORIGIN", b"Origin: \xc3\xa9\r\n"), 403),
    "a path in UTF-8": (b"GET /\xc3\xa9 HTTP/1.1\r\nHOST\r\n", (400, None)),
    "a host with NUL": (b"GET / HTTP/1.1\r\nHost: \0\r\n\r\n", None),
    "no header": (b"GET / HTTP/1.1\r\nHOSTnonsense\r\n\r\n", None),
    "a body": (b"GET /TOKEN/ HTTP/1.1\r\nHOSTContent-Length: 3\r\n\r\nabc", None),
    "HTTP/2": (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", None),
    "TLS": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", None),
    "half a line": (b"GET / HT", None),
    "nothing": (b"", None),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_request_gets_an_error_and_prints_nothing(running, capfd, name):
    request, expected = MALFORMED[name]
    port = running.studio.port
    request = request.replace(b"HOST", b"Host: 127.0.0.1:%d\r\n" % port).replace(
        b"TOKEN", running.studio.token.encode()
    )
    request = request.replace(b"ORIGIN", b"Origin: http://127.0.0.1:%d\r\n" % port)
    answer = b""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as raw, contextlib.suppress(ConnectionError):
        # The server may close the connection before it has read the whole request.
        raw.sendall(request)
        if not request.endswith(b"\n"):
            raw.shutdown(socket.SHUT_WR)
        while part := raw.recv(1 << 16):
            answer += part
    status = int(answer.split()[1]) if answer else None
    assert status in (expected if isinstance(expected, tuple) else (expected,))
    assert running.get(f"/{running.studio.token}/")[0] == 200
    assert capfd.readouterr().err == ""


def test_an_internal_error_of_the_server_is_logged(running, monkeypatch, caplog):
    def broken():
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr(served, "assets", broken)
    assert running.get(f"/{running.studio.token}/")[0] == 500
    until = time.monotonic() + 5
    while "a defect" not in caplog.text and time.monotonic() < until:
        time.sleep(0.01)
    assert "a defect" in caplog.text
