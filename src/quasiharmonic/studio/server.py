"""The server of the page: the page's files, and for each page that is open a process that computes for it.

It listens on this machine alone. Everything it hands out asks for the token that is in the address, which a
browser sends for no other site; a request that names another host is refused, so that no other name can be made to
point here, and so is a socket that was opened from another origin.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
from collections.abc import Callable
from http import HTTPStatus
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from quasiharmonic.studio.assets import assets
from quasiharmonic.studio.pages import Page
from quasiharmonic.studio.protocol import ProtocolError, decode, encode

HOST = "127.0.0.1"
#: Bytes of a file dropped on a page, and pages at a time.
MOST_BYTES, MOST_PAGES = 128 << 20, 8
#: How a socket is closed while there are so many.
TRY_LATER = 1013
# Nothing is loaded from elsewhere, nothing may frame the page, and the address with its token is told to nobody.
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class Studio:
    """The server.

    Parameters
    ----------
    source : str
        The file that pages begin with; a surface of ours if it is empty.
    token : str, optional
        What has to be in the address.
    """

    def __init__(self, source: str = "", token: str | None = None) -> None:
        self.source = source
        self.token = secrets.token_urlsafe(24) if token is None else token
        self.port = 0
        self._pages: set[Page] = set()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    async def run(self, port: int = 0, ready: Callable[[str], object] = lambda address: None) -> None:
        """Serve until cancelled.

        Parameters
        ----------
        port : int
            Any that is free for 0.
        ready : callable
            Is told the address.

        Raises
        ------
        OSError
            When the port is taken.
        """
        async with serve(
            self._page,
            HOST,
            port,
            process_request=self._request,
            max_size=MOST_BYTES + (1 << 20),
            max_queue=64,
            compression=None,
            server_header=None,
            ping_timeout=60,
        ) as server:
            self.port = _port_of(server)
            ready(self.address)
            try:
                await server.serve_forever()
            finally:
                await asyncio.gather(*(page.ended() for page in list(self._pages)))

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a request, answer it with a file, or let it become a socket."""
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or hosts[0] not in {f"{HOST}:{self.port}", f"localhost:{self.port}"}:
            return _answer(HTTPStatus.MISDIRECTED_REQUEST, "this address is not served here")
        path = urlsplit(request.path).path
        token, slash, name = path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return _answer(HTTPStatus.FORBIDDEN, "the token in the address is missing or wrong: copy all of it")
        if not slash:
            # What the page asks for lies beside it, behind the slash that was left out.
            return _answer(HTTPStatus.PERMANENT_REDIRECT, "the address ends with a slash", location=f"/{self.token}/")
        if name == "socket":
            origins = request.headers.get_all("Origin")
            if origins != [f"http://{hosts[0]}"]:
                return _answer(HTTPStatus.FORBIDDEN, "the page of another site must not speak to this one")
            return None
        asset = assets().get(name or "index.html")
        if asset is None:
            return _answer(HTTPStatus.NOT_FOUND, "there is no such file")
        return _answer(HTTPStatus.OK, asset.content, asset.kind)

    async def _page(self, connection: ServerConnection) -> None:
        """Be between a page and its process until one of them goes."""
        if len(self._pages) >= MOST_PAGES:
            # Said here and not in the answer to the request, which a browser shows to no script.
            await connection.close(TRY_LATER, f"{MOST_PAGES} pages are open")
            return

        async def tell(message: bytes) -> None:
            await connection.send(message)

        await tell(encode({"kind": "hello", "most_bytes": MOST_BYTES}))
        page = await Page.start(self.source, tell)
        self._pages.add(page)
        listening = asyncio.ensure_future(self._listen(connection, page))
        try:
            why = await page.run()
            await tell(encode({"kind": "note", "level": "gone", "text": f"{why}. The page begins anew."}))
            await connection.close(1011, "the process has ended")
        except ConnectionClosed:
            pass
        finally:
            listening.cancel()
            await page.ended()
            self._pages.discard(page)

    async def _listen(self, connection: ServerConnection, page: Page) -> None:
        """Hand over what the page sends."""
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
            # Whoever has gone waits for nothing.
            page.end()


def _answer(
    status: HTTPStatus, body: str | bytes, kind: str = "text/plain; charset=utf-8", *, location: str | None = None
) -> Response:
    content = body.encode() + b"\n" if isinstance(body, str) else body
    headers = Headers({**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content)), "Connection": "close"})
    if location is not None:
        headers["Location"] = location
    return Response(status.value, status.phrase, headers, content)


def _port_of(server: Server) -> int:
    port: int = next(iter(server.sockets)).getsockname()[1]
    return port
