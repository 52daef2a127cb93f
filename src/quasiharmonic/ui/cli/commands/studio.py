"""``qhm studio``: edit a map interactively in the browser.

Open a page with a surface beside its map: drag corners, pins and the boundary, and the map follows. Every map shown
is certified. Needs the extra 'studio'. Only this machine can open the page, at the address that is printed. Ctrl-C
stops the server.

Exit status: 0 ended by Ctrl-C; 2 wrong input or call.

    qhm studio
    qhm studio model.obj
"""

from __future__ import annotations

import argparse
from pathlib import Path

from quasiharmonic.util.hints import explain_missing


def declare_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    from quasiharmonic.io.registry import format_names

    parser.add_argument(
        "input",
        type=Path,
        nargs="?",
        metavar="INPUT",
        help=f"{format_names('read')} file, or a folder with input.obj (or .ply), handles.txt (default: a cat's head)",
    )
    parser.add_argument("--port", type=int, default=0, metavar="N", help="port to listen on (default: any free port)")
    parser.add_argument("--no-browser", action="store_true", help="print the address and do not open the browser")


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    import asyncio
    import signal
    import webbrowser
    from contextlib import suppress

    with explain_missing("the page needs the package websockets", extra="studio"):
        import websockets.asyncio.server  # noqa: F401
    from quasiharmonic.ui.studio.server import Studio

    source = ""
    if options.input is not None:
        from quasiharmonic.ui.studio.surface import read_sheet

        # Errors of the input are reported here rather than on the page.
        read_sheet(options.input)
        source = str(options.input.resolve())

    def ready(address: str) -> None:
        print(address, flush=True)
        if not options.no_browser:
            webbrowser.open(address)

    # asyncio ends cleanly on Ctrl-C only if Python's default handler is installed.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    with suppress(KeyboardInterrupt):
        asyncio.run(Studio(source).run(options.port, ready))
    return 0
