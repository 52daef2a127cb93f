"""Web server of the application: static files, and one worker process for each open page.

The server listens only on this machine. Every request needs the token in the address, which other sites do not know.
Requests with another host name are rejected, which prevents DNS rebinding. Sockets from other origins
are rejected, too.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import re
import secrets
import sys
import tempfile
from collections.abc import Awaitable, Callable
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.http11 import Request, Response

from quasiharmonic.ui.batch.supervisor import resident
from quasiharmonic.ui.studio.page import assets, offered_options
from quasiharmonic.ui.studio.protocol import ProtocolError, decode, encode
from quasiharmonic.util.options import ENERGY_LABELS

HOST = "127.0.0.1"
#: Maximum size of an uploaded file in bytes.
MAX_BYTES = 128 << 20
#: Maximum number of open pages.
MAX_PAGES = 8
#: Close code of a socket whose session was opened in another tab.
ELSEWHERE = 4001
# Name of a session, which a page chooses at random; it is the name of a folder.
_SESSION = re.compile(r"[0-9a-f]{32}")
#: Close code of a socket if too many pages are open.
TRY_LATER = 1013
# Code of the worker process; -P prevents imports from the working directory.
_CODE = "import sys; from quasiharmonic.ui.studio.page_worker import serve; serve(*sys.argv[1:])"
#: Memory limit of one page, bytes.
MAX_MEMORY = 6 << 30
# Seconds between two checks, and seconds until a process must react to "stop".
_CHECK_INTERVAL = 0.5
_STOP_TIMEOUT = 15.0
# Bytes written to a process at a time, to avoid a second copy of large messages.
_WRITE_SIZE = 1 << 18
# Load nothing from other sites, forbid framing, and never send the address with its token as a referrer.
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Studio:
    """Web server; pages open the file ``source``, or a built-in surface if it is empty.

    The token is the secret part of the address; random by default.
    """

    def __init__(self, source: str = "", token: str | None = None) -> None:
        self.source = source
        self.token = secrets.token_urlsafe(24) if token is None else token
        self.port = 0
        self._pages: set[PageProcess] = set()
        self._sessions: dict[str, tuple[ServerConnection, PageProcess]] = {}
        self._folder = ""
        self._open = 0

    @property
    def address(self) -> str:
        """The address to open in a browser."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    async def run(self, port: int = 0, ready: Callable[[str], object] = lambda address: None) -> None:
        """Serve until cancelled.

        Parameters
        ----------
        port : int
            0 for any free port.
        ready : callable
            Called with the address.

        Raises
        ------
        OSError
            If the port is in use.
        """
        with tempfile.TemporaryDirectory(prefix="qhm-studio-", ignore_cleanup_errors=True) as self._folder:
            await self._serve(port, ready)

    async def _serve(self, port: int, ready: Callable[[str], object]) -> None:
        async with serve(
            self._connect_page,
            HOST,
            port,
            process_request=self._answer_request,
            max_size=MAX_BYTES + (1 << 20),
            # Read a message only after the previous one was taken, so that at most one large message waits.
            max_queue=0,
            compression=None,
            logger=_logger(),
            server_header=None,
            ping_timeout=60,
            close_timeout=2,
        ) as server:
            self.port = next(iter(server.sockets)).getsockname()[1]
            ready(self.address)
            try:
                await server.serve_forever()
            finally:
                await asyncio.gather(*(page.wait_for_end() for page in list(self._pages)))

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a request, answer it with a file, or return None to open a socket."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or hosts[0] not in {f"{HOST}:{self.port}", f"localhost:{self.port}"}:
            return _answer(HTTPStatus.MISDIRECTED_REQUEST, "unknown address")
        if getattr(request, "method", "GET") != "GET":
            return _answer(HTTPStatus.METHOD_NOT_ALLOWED, "files are read with GET", allow="GET")
        path = request.path.partition("?")[0]
        key = "".join(request.headers.get_all("Sec-WebSocket-Key"))
        if not path.startswith("/") or not path.isascii() or not key.isascii():
            return _answer(HTTPStatus.BAD_REQUEST, "the request is malformed")
        token, slash, name = path[1:].partition("/")
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return _answer(HTTPStatus.FORBIDDEN, "the token in the address is missing or wrong: copy all of it")
        if not slash:
            # Relative addresses of the page need the final slash.
            return _answer(HTTPStatus.PERMANENT_REDIRECT, "the address ends with a slash", location=f"/{self.token}/")
        if name == "socket":
            origins = request.headers.get_all("Origin")
            if origins != [f"http://{hosts[0]}"]:
                return _answer(HTTPStatus.FORBIDDEN, "requests from other sites are not allowed")
            return None
        asset = assets().get(name or "index.html")
        if asset is None:
            return _answer(HTTPStatus.NOT_FOUND, "there is no such file")
        return _answer(HTTPStatus.OK, asset.content, asset.kind)

    async def _connect_page(self, connection: ServerConnection) -> None:
        """Connect a page with a process, unless too many pages are open."""
        if self._open >= MAX_PAGES:
            # Close the socket instead of refusing the request, because scripts cannot read the answer to a refusal.
            await connection.close(TRY_LATER, f"{MAX_PAGES} pages are open, which is the maximum")
            return
        # Count before the first await, so that pages opened at the same time cannot exceed the limit.
        self._open += 1
        try:
            await self._forward(connection)
        except ConnectionClosed:
            pass
        finally:
            self._open -= 1

    async def _forward(self, connection: ServerConnection) -> None:
        """Forward messages between a page and its process until one of them ends."""

        async def tell(message: bytes) -> None:
            await connection.send(message)

        offered = {"options": offered_options(), "energies": ENERGY_LABELS}
        await tell(encode({"kind": "hello", "most_bytes": MAX_BYTES, **offered}))
        session = self._read_session_name(connection)
        await self._take_over(session)
        try:
            page = await PageProcess.start(self.source, tell, str(Path(self._folder, session)) if session else "")
        except OSError as error:
            reason = f"no process can be started for this page: {error.strerror or error}"
            await tell(encode({"kind": "note", "level": "error", "text": reason}))
            await connection.close(TRY_LATER, reason[:100])
            return
        self._pages.add(page)
        if session:
            self._sessions[session] = connection, page
        listening = asyncio.ensure_future(self._listen(connection, page))
        try:
            why = await page.run()
            await tell(encode({"kind": "note", "level": "gone", "text": f"{why}. The page restarts."}))
            await connection.close(1011, "the process has ended")
        finally:
            listening.cancel()
            await page.wait_for_end()
            self._pages.discard(page)
            if self._sessions.get(session, (None, None))[1] is page:
                del self._sessions[session]

    def _read_session_name(self, connection: ServerConnection) -> str:
        """Return the name of the session that a page asks for; empty if there is none."""
        assert connection.request is not None
        name = connection.request.path.partition("?session=")[2]
        return name if _SESSION.fullmatch(name) else ""

    async def _take_over(self, session: str) -> None:
        """End the page that has a session, as after a reload or in another tab."""
        if session in self._sessions:
            connection, page = self._sessions.pop(session)
            await connection.close(ELSEWHERE, "this session was opened in another tab")
            await page.wait_for_end()

    async def _listen(self, connection: ServerConnection, page: PageProcess) -> None:
        """Forward the messages of the page to its process."""
        try:
            async for message in connection:
                if isinstance(message, str):
                    await connection.close(1003, "messages are binary")
                    break
                try:
                    stops = decode(message).header.get("do") == "stop"
                except ProtocolError as error:
                    await connection.close(1007, str(error)[:100])
                    break
                await page.send(message, stops=stops)
        except ConnectionClosed:
            pass
        finally:
            # The page is gone, so its process is not needed.
            page.end()


def _logger() -> logging.Logger:
    """Return a logger that records errors of the server but not those caused by clients."""
    logger = logging.getLogger(__name__)
    logger.addFilter(_not_the_clients)
    return logger


def _not_the_clients(record: logging.LogRecord) -> bool:
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, (WebSocketException, EOFError, ConnectionError))


def _answer(status: HTTPStatus, body: str | bytes, kind: str = "text/plain; charset=utf-8", **further: str) -> Response:
    content = body.encode() + b"\n" if isinstance(body, str) else body
    headers = Headers({**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content)), "Connection": "close"})
    headers.update({name.title(): value for name, value in further.items()})
    return Response(status.value, status.phrase, headers, content)


class PageProcess:
    """Worker process of a page; ``tell`` sends a message of the process to the page."""

    def __init__(self, process: asyncio.subprocess.Process, tell: Callable[[bytes], Awaitable[None]]) -> None:
        self._process, self._tell = process, tell
        self._stop_asked: float | None = None
        self._reason = ""

    @classmethod
    async def start(cls, source: str, tell: Callable[[bytes], Awaitable[None]], folder: str = "") -> PageProcess:
        """Start a process for a page that opens ``source``, or a built-in surface if it is empty.

        The process stores its session in ``folder``, and continues the one that is there.
        """
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-P",
            "-c",
            _CODE,
            source,
            folder,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=1 << 20,
        )
        return cls(process, tell)

    async def send(self, message: bytes, *, stops: bool = False) -> None:
        """Send a message of the page to the process; after a message that ``stops``, the process must answer soon."""
        assert self._process.stdin is not None
        if stops and self._stop_asked is None:
            self._stop_asked = asyncio.get_running_loop().time()
        with suppress(ConnectionError, RuntimeError):
            self._process.stdin.write(len(message).to_bytes(8, "little"))
            for start in range(0, len(message), _WRITE_SIZE):
                self._process.stdin.write(message[start : start + _WRITE_SIZE])
                await self._process.stdin.drain()

    async def run(self) -> str:
        """Forward messages of the process until it ends; return the reason for its end."""
        watch = asyncio.ensure_future(self._watch())
        assert self._process.stdout is not None
        try:
            while True:
                head = await self._process.stdout.readexactly(8)
                message = await self._process.stdout.readexactly(int.from_bytes(head, "little"))
                self._stop_asked = None
                await self._tell(message)
        except asyncio.IncompleteReadError:
            code = await self._process.wait()
            return self._reason or f"the process of this page has ended (exit status {code})"
        finally:
            watch.cancel()

    async def _watch(self) -> None:
        """Kill the process if it uses too much memory or does not react to "stop"."""
        clock = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(_CHECK_INTERVAL)
            if (resident(self._process.pid) or 0) > MAX_MEMORY:
                self._reason = f"this surface used more than {MAX_MEMORY >> 30} GiB of memory"
            elif self._stop_asked is not None and clock() - self._stop_asked > _STOP_TIMEOUT:
                self._reason = "the computation could not be stopped"
            else:
                continue
            self.end()
            return

    def end(self) -> None:
        """Kill the process."""
        with suppress(ProcessLookupError):
            self._process.kill()

    async def wait_for_end(self) -> None:
        """Kill the process and wait for its end."""
        self.end()
        await self._process.wait()
