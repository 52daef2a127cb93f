"""The process of one page: messages come on standard input, and what is told to the page goes to standard output.

Each is a message of `quasiharmonic.studio.protocol` behind its length, eight bytes, little-endian. Whatever becomes of
this process, a crash in a library included, `quasiharmonic.studio.pages` and the other pages go on.
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

from quasiharmonic.studio.protocol import Array, Frame, decode, encode
from quasiharmonic.studio.session import Session
from quasiharmonic.studio.sheets import read_sheet


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
        Read by a thread of its own. Where it ends, so does the process.
    """

    def __init__(self, source: BinaryIO) -> None:
        self._messages: deque[Frame] = deque()
        self._arrived = threading.Condition()
        threading.Thread(target=self._listen, args=(source,), daemon=True).start()

    def _listen(self, source: BinaryIO) -> None:
        while len(head := source.read(8)) == 8:
            self.put(decode(source.read(int.from_bytes(head, "little"))))
        # The page has gone, and nobody waits for what is at hand.
        os._exit(0)

    def put(self, frame: Frame) -> None:
        """Add a message."""
        with self._arrived:
            what = frame.header.get("do")
            if what == "drag" and self._messages and self._messages[-1].header.get("do") == "drag":
                self._messages.pop()
            self._messages.append(frame)
            self._arrived.notify()

    def take(self) -> Frame:
        """The next message, as soon as there is one."""
        with self._arrived:
            while not self._messages:
                self._arrived.wait()
            return self._messages.popleft()

    def waiting(self) -> bool:
        """Whether there is one that makes what is going on needless; to save something does not."""
        return any(frame.header.get("do") != "save" for frame in self._messages.copy())
