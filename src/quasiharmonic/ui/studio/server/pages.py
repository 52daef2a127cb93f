"""Worker processes of pages, seen from the server: start, send, receive, limit, end."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress

from quasiharmonic.ui.batch.supervisor import resident

# Code of the worker process; -P prevents imports from the working directory.
_CODE = "import sys; from quasiharmonic.ui.studio.server.page_worker import serve; serve(*sys.argv[1:])"
#: Memory limit of one page, bytes.
MAX_MEMORY = 6 << 30
# Seconds between two checks, and seconds until a process must react to "stop".
_CHECK_INTERVAL = 0.5
_STOP_TIMEOUT = 15.0
# Bytes written to a process at a time, to avoid a second copy of large messages.
_WRITE_SIZE = 1 << 18


class Page:
    """Worker process of a page; ``tell`` sends a message of the process to the page."""

    def __init__(self, process: asyncio.subprocess.Process, tell: Callable[[bytes], Awaitable[None]]) -> None:
        self._process, self._tell = process, tell
        self._stop_asked: float | None = None
        self._reason = ""

    @classmethod
    async def start(cls, source: str, tell: Callable[[bytes], Awaitable[None]], folder: str = "") -> Page:
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

    async def ended(self) -> None:
        """Kill the process and wait for its end."""
        self.end()
        await self._process.wait()
