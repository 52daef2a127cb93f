"""Worker process of one page: reads messages from standard input, writes messages to standard output.

Each message is one of `quasiharmonic.ui.studio.protocol`, preceded by its length as eight bytes, little-endian. If this
process crashes, the server and the other pages continue.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from quasiharmonic.ui.studio.history import Storage
from quasiharmonic.ui.studio.protocol import Array, MessageFrame, decode, encode
from quasiharmonic.ui.studio.session import Session
from quasiharmonic.ui.studio.surface import read_sheet
from quasiharmonic.ui.worker_pipes import open_pipes

#: Maximum total size of waiting messages, bytes.
MAX_WAITING = 256 << 20
# Messages that do not interrupt a computation.
_HARMLESS = {"save", "image", "select"}
# Memory of a message besides its contents, bytes.
_OVERHEAD = 1024


def serve(source: str, folder: str = "") -> None:
    """Handle messages from standard input until it is closed; open ``source``, or a built-in surface if it is empty.

    The session is stored in ``folder``. If a stored session is there, it continues.
    """
    requests, send = open_pipes()

    def tell(header: Mapping[str, Any], arrays: Mapping[str, Array]) -> None:
        message = encode(header, arrays)
        send(len(message).to_bytes(8, "little") + message)

    inbox = Inbox(requests)
    session = Session(tell, inbox.waiting, Storage(Path(folder)) if folder else None, inbox.stops)
    try:
        if session.restore():
            tell({"kind": "restored"}, {})
        else:
            session.open(read_sheet(Path(source)) if source else None)
    except (ValueError, OSError, ArithmeticError, RuntimeError) as error:
        tell({"kind": "note", "level": "error", "text": str(error)}, {})
        session.open()
    while True:
        session.handle(inbox.take())


class Inbox:
    """Queue of incoming messages; of consecutive unread drag messages only the last one is kept.

    A separate thread reads the binary file ``source``, and pauses while too many bytes wait. When the file ends, the
    process exits.
    """

    def __init__(self, source: BinaryIO) -> None:
        self._messages: deque[tuple[MessageFrame, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        threading.Thread(target=self._listen, args=(source,), daemon=True).start()

    def _listen(self, source: BinaryIO) -> None:
        while len(head := source.read(8)) == 8:
            length = int.from_bytes(head, "little")
            self._put(decode(source.read(length)), length + _OVERHEAD)
        # The page is gone, so the current computation is not needed.
        os._exit(0)

    def _put(self, frame: MessageFrame, size: int) -> None:
        """Add a message as soon as the queue has space for it."""
        with self._changed:
            last = self._messages[-1][0].header.get("do") if self._messages else None
            if frame.header.get("do") == last == "drag":
                self._bytes -= self._messages.pop()[1]
            while self._messages and self._bytes + size > MAX_WAITING:
                self._changed.wait()
            self._messages.append((frame, size))
            self._bytes += size
            self._changed.notify()

    def take(self) -> MessageFrame:
        """Return the next message; wait for it if necessary."""
        with self._changed:
            while not self._messages:
                self._changed.wait()
            frame, size = self._messages.popleft()
            self._bytes -= size
            self._changed.notify()
            return frame

    def stops(self) -> bool:
        """Whether a waiting message asks for the best result so far."""
        return any(frame.header.get("do") == "stop" for frame, _ in self._messages.copy())

    def waiting(self) -> bool:
        """Whether a waiting message makes the current computation unnecessary; `_HARMLESS` ones do not."""
        return any(frame.header.get("do") not in _HARMLESS for frame, _ in self._messages.copy())
