"""The process of one page: messages come on standard input, and what is told to the page goes to standard output.

Each is a message of `quasiharmonic.ui.studio.protocol` behind its length, eight bytes, little-endian. Whatever becomes
of this process, a crash in a library included, `quasiharmonic.ui.studio.pages` and the other pages go on.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from quasiharmonic.ui.studio.protocol import Array, Frame, decode, encode
from quasiharmonic.ui.studio.session import Session
from quasiharmonic.ui.studio.surface import read_sheet

#: Bytes of messages that may wait.
MOST_WAITING = 256 << 20
# Bytes that a message takes beside its contents.
_OVERHEAD = 1024


def serve(source: str) -> None:
    """Do what comes on standard input until that ends.

    Parameters
    ----------
    source : str
        The file that the page begins with, if it is not empty.
    """
    # Ctrl-C reaches the whole group; the server decides what becomes of this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable(all_threads=False)
    answers = os.fdopen(os.dup(1), "wb")
    # What libraries print must not come between the answers.
    os.dup2(2, 1)

    def tell(header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        message = encode(header, arrays)
        try:
            answers.write(len(message).to_bytes(8, "little") + message)
            answers.flush()
        except OSError:
            # Whoever listened has gone.
            os._exit(0)

    inbox = Inbox(os.fdopen(os.dup(0), "rb"))
    session = Session(tell, inbox.waiting)
    try:
        session.open(read_sheet(Path(source)) if source else None)
    except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
        tell({"kind": "note", "level": "error", "text": str(error)}, {})
        session.open()
    while True:
        session.handle(inbox.take())


class Inbox:
    """Messages as they come; of movements of a hand that nobody has looked at yet only the last one counts.

    Parameters
    ----------
    source : binary file
        Read by a thread of its own, which stops while too many bytes wait. Where it ends, so does the process.
    """

    def __init__(self, source: BinaryIO) -> None:
        self._messages: deque[tuple[Frame, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        threading.Thread(target=self._listen, args=(source,), daemon=True).start()

    def _listen(self, source: BinaryIO) -> None:
        while len(head := source.read(8)) == 8:
            length = int.from_bytes(head, "little")
            self._put(decode(source.read(length)), length + _OVERHEAD)
        # The page has gone, and nobody waits for what is at hand.
        os._exit(0)

    def _put(self, frame: Frame, size: int) -> None:
        """Add a message as soon as there is room for it."""
        with self._changed:
            last = self._messages[-1][0].header.get("do") if self._messages else None
            if frame.header.get("do") == last == "drag":
                self._bytes -= self._messages.pop()[1]
            while self._messages and self._bytes + size > MOST_WAITING:
                self._changed.wait()
            self._messages.append((frame, size))
            self._bytes += size
            self._changed.notify()

    def take(self) -> Frame:
        """The next message, as soon as there is one."""
        with self._changed:
            while not self._messages:
                self._changed.wait()
            frame, size = self._messages.popleft()
            self._bytes -= size
            self._changed.notify()
            return frame

    def waiting(self) -> bool:
        """Whether there is one that makes what is going on needless; to save something does not."""
        return any(frame.header.get("do") != "save" for frame, _ in self._messages.copy())
