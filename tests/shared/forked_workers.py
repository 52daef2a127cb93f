"""Worker processes of data sets that start quickly: copies of a process that has imported the library.

`Forks.open` replaces `subprocess.Popen` in `quasiharmonic.ui.batch.supervisor`. A worker is still a process with the
same pipes and the same function. Only its imports are saved, which take most of the time of a small problem.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time


class Fork:
    """The methods of `subprocess.Popen` that the supervisor calls."""

    def __init__(self, pid, status, stdin, stdout):
        self.pid, self.stdin, self.stdout = pid, stdin, stdout
        self.returncode = None
        self._status, self._lock = status, threading.Lock()

    def poll(self):
        with self._lock:
            if self.returncode is None and select.select([self._status], [], [], 0)[0]:
                self.returncode = int(os.read(self._status, 16))
                os.close(self._status)
        return self.returncode

    def wait(self):
        while self.poll() is None:
            time.sleep(0.001)
        return self.returncode

    def kill(self):
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class Forks:
    """A process that has imported the library, and the workers that are copied from it.

    ``scripts`` maps commands to the script that a copy runs instead.
    """

    PIPE = subprocess.PIPE

    def __init__(self, scripts):
        self._scripts, self._lock, self._process = scripts, threading.Lock(), None

    def open(self, command, **options):
        """Start a worker, or any other command as usual."""
        script = next((script for known, script in self._scripts if command == known), None)
        if script is None:
            return subprocess.Popen(command, **options)
        (stdin, to), (source, stdout), (status, ended) = os.pipe(), os.pipe(), os.pipe()
        with self._lock:
            if self._process is None:
                self._socket, theirs = socket.socketpair()
                program = [sys.executable, "-P", __file__, str(theirs.fileno())]
                self._process = subprocess.Popen(program, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
                theirs.close()
            numbers = [stdin, stdout, options["stderr"].fileno(), ended]
            socket.send_fds(self._socket, [script.encode() + b"\0"], numbers)
            pid = int(self._socket.recv(16))
        for number in (stdin, stdout, ended):
            os.close(number)
        return Fork(pid, status, os.fdopen(to, "wb"), os.fdopen(source, "rb"))

    def close(self):
        if self._process is not None:
            self._socket.close()
            self._process.wait()


def serve_copies(channel):
    """Copy this process for every request and report how each copy ends; return the script in a copy."""
    wake, woken = os.pipe()
    os.set_blocking(woken, False)
    signal.set_wakeup_fd(woken)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    # Ctrl-C reaches all processes of the terminal; the tests decide when this one ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    reports = {}
    while True:
        ready, _, _ = select.select([channel, wake], [], [])
        if wake in ready:
            os.read(wake, 1 << 12)
            for pid, report in list(reports.items()):
                ended, status = os.waitpid(pid, os.WNOHANG)
                if ended:
                    with contextlib.suppress(BrokenPipeError):
                        os.write(report, str(os.waitstatus_to_exitcode(status)).encode())
                    os.close(reports.pop(pid))
        if channel in ready:
            script, numbers, _, _ = socket.recv_fds(channel, 1 << 12, 4)
            if not script:
                sys.exit()
            pid = os.fork()
            if pid == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for place, number in enumerate(numbers[:3]):
                    os.dup2(number, place)
                for number in (*numbers, wake, woken, *reports.values()):
                    os.close(number)
                channel.close()
                return script.rstrip(b"\0").decode()
            reports[pid] = numbers[3]
            for number in numbers[:3]:
                os.close(number)
            channel.send(str(pid).encode())


# Modules that a worker imports while it solves its first problem.
LATER = "fontTools.ttLib", "quasiharmonic.io.formats.obj", "quasiharmonic.apps.atlas.packing.pack"

if __name__ == "__main__":
    from quasiharmonic.linsolve import make_solver
    from quasiharmonic.ui.batch import worker

    make_solver([0, 1], [0]).close()
    for module in LATER:
        with contextlib.suppress(ImportError):
            importlib.import_module(module)
    if script := serve_copies(socket.socket(fileno=int(sys.argv[1]))):
        runpy.run_path(script, run_name="__main__")
    else:
        worker.serve()
