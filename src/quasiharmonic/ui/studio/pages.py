"""The processes of pages from the server's side: started, fed, listened to, kept within limits, ended."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress

from quasiharmonic.ui.batch.supervisor import resident

# What runs in the process; -P keeps modules that happen to lie in the working directory out of it.
_CODE = "import sys; from quasiharmonic.ui.studio.worker import serve; serve(sys.argv[1])"
#: Bytes of memory that one page may take.
MOST_MEMORY = 6 << 30
# Seconds between two looks at that, and those that a process may be deaf to "stop".
_LOOK = 0.5
_DEAF = 15.0
# Bytes that are handed to a process at a time; no second copy of a large message is made.
_PIECE = 1 << 18


class Page:
    """A page's process.

    Parameters
    ----------
    process : asyncio.subprocess.Process
    tell : coroutine function
        Carries what the process tells to the page.
    """

    def __init__(self, process: asyncio.subprocess.Process, tell: Callable[[bytes], Awaitable[None]]) -> None:
        self._process, self._tell = process, tell
        self._heard = asyncio.get_running_loop().time()
        self._stop_asked: float | None = None
        self._why = ""

    @classmethod
    async def start(cls, source: str, tell: Callable[[bytes], Awaitable[None]]) -> Page:
        """Start a process for a page that begins with a file, or with a surface of ours."""
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-P",
            "-c",
            _CODE,
            source,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            limit=1 << 20,
        )
        return cls(process, tell)

    async def send(self, message: bytes, *, stops: bool = False) -> None:
        """Hand over a message of the page; one that ``stops`` has to be heard soon."""
        assert self._process.stdin is not None
        if stops and self._stop_asked is None:
            self._stop_asked = asyncio.get_running_loop().time()
        with suppress(ConnectionError, RuntimeError):
            self._process.stdin.write(len(message).to_bytes(8, "little"))
            for start in range(0, len(message), _PIECE):
                self._process.stdin.write(message[start : start + _PIECE])
                await self._process.stdin.drain()

    async def run(self) -> str:
        """Carry on what the process tells until it ends; why it has."""
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
            return self._why or f"the process of this page has ended (exit status {code})"
        finally:
            watch.cancel()

    async def _watch(self) -> None:
        """End the process where it takes too much memory, or cannot be stopped."""
        clock = asyncio.get_running_loop().time
        while True:
            await asyncio.sleep(_LOOK)
            if (resident(self._process.pid) or 0) > MOST_MEMORY:
                self._why = f"this surface used more than {MOST_MEMORY >> 30} GiB of memory"
            elif self._stop_asked is not None and clock() - self._stop_asked > _DEAF:
                self._why = "the computation could not be stopped"
            else:
                continue
            self.end()
            return

    def end(self) -> None:
        """Kill the process."""
        with suppress(ProcessLookupError):
            self._process.kill()

    async def ended(self) -> None:
        """Kill the process and wait until it is gone."""
        self.end()
        await self._process.wait()
