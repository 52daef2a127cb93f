"""Processes of studio pages that start quickly: copies of a process that has imported the library.

`Forks.executable` replaces Python in `quasiharmonic.ui.studio.server.pages`. The server starts it as a process, which
only passes on its streams to a copy, ends when the copy ends, and takes the copy with it when it is killed.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
from pathlib import Path

CLIENT = """#!{python} -IS
import os, signal, socket, sys
with socket.socket(socket.AF_UNIX) as server:
    server.connect({address!r})
    socket.send_fds(server, ["\\0".join(sys.argv[-2:]).encode() + b"\\0"], [0, 1, 2])
    os.close(0)
    os.close(1)
    status = int(server.recv(16) or b"1")
if status < 0:
    signal.signal(-status, signal.SIG_DFL)
    os.kill(os.getpid(), -status)
os._exit(status)
"""


class Forks:
    """A process that has imported the library, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.executable = folder / "python"
        self.executable.write_text(CLIENT.format(python=sys.executable, address=str(folder / "socket")))
        self.executable.chmod(0o700)
        command = [sys.executable, "-P", __file__, str(folder / "socket")]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdout.readline() == b"ready\n"

    def close(self) -> None:
        self._process.communicate()


def serve_copies(listener):
    """Copy this process for every client and pass on how each copy ends; return the words of the client in a copy.

    The process ends with its standard input.
    """
    wake, woken = os.pipe()
    os.set_blocking(woken, False)
    signal.set_wakeup_fd(woken)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    # Ctrl-C reaches all processes of the terminal; the tests decide when this one ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    clients = {}
    while True:
        ready, _, _ = select.select([0, listener, wake, *clients.values()], [], [])
        if 0 in ready:
            sys.exit()
        for pid, client in list(clients.items()):
            if client in ready:  # it was killed
                os.kill(pid, signal.SIGKILL)
        if wake in ready:
            os.read(wake, 1 << 12)
        for pid, client in list(clients.items()):
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                with contextlib.suppress(OSError), clients.pop(pid):
                    client.send(str(os.waitstatus_to_exitcode(status)).encode())
        if listener in ready:
            client, _ = listener.accept()
            words, numbers, _, _ = socket.recv_fds(client, 1 << 12, 3)
            if not numbers:  # it was killed
                client.close()
                continue
            pid = os.fork()
            if pid == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for place, number in enumerate(numbers):
                    os.dup2(number, place)
                for number in (*numbers, wake, woken):
                    os.close(number)
                for other in (listener, client, *clients.values()):
                    other.close()
                return words.decode().split("\0")[:2]
            clients[pid] = client
            for number in numbers:
                os.close(number)


if __name__ == "__main__":
    from quasiharmonic.ui.studio.server import page_worker

    with socket.socket(socket.AF_UNIX) as waiting:
        waiting.bind(sys.argv[1])
        waiting.listen(32)
        print("ready", flush=True)
        given = serve_copies(waiting)
    page_worker.serve(*given)
