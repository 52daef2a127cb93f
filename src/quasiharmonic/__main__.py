"""The command ``qhm``, also ``python -m quasiharmonic``, as a process.

All imports are inside `main`, so that Ctrl-C during an import ends the process with a message instead of a traceback.
"""


def main() -> int:
    """Run the command with the arguments of the process; return the exit status, with which the process must end."""
    try:
        from quasiharmonic.ui.cli import main as run

        status = run()
    except SystemExit as end:
        # argparse exits after a page of help, after the version, and after a wrong call.
        status = end.code if isinstance(end.code, int) else 0
    except KeyboardInterrupt:
        import sys

        print("qhm: interrupted, nothing was written", file=sys.stderr)
        status = 2
    finally:
        import signal

        # The command has reported its result, and an interrupt must not change the exit status any more.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # If an interrupt leaves an `exec`, Python marks it as unhandled, even if it is caught later, and then ends the
        # process by SIGINT in place of the status. Such an `exec` runs when the module of a dataclass is imported.
        # The next `exec` removes the mark.
        exec("")
    from quasiharmonic.ui.cli.process import finish

    return finish(status)


if __name__ == "__main__":
    raise SystemExit(main())
