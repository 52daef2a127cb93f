"""The command ``qhm``, which is ``python -m quasiharmonic``, as a process.

Nothing is imported before it is seen to that Ctrl-C ends the process in a sentence.
"""


def main() -> int:
    """Run the command with the arguments of the process, which then ends; its exit status."""
    try:
        from quasiharmonic.ui.cli import main as run

        status = run()
    except SystemExit as end:
        # A page of help, the version, or a wrong call.
        status = end.code if isinstance(end.code, int) else 0
    except KeyboardInterrupt:
        import sys

        print("qhm: interrupted, nothing was written", file=sys.stderr)
        status = 2
    finally:
        import signal

        # What has been said stays true: all that is left to do is to end.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # An interrupt that came out of an `exec`, as of a dataclass while it is loaded, counts as unhandled, and would
        # end the process by a signal in place of its status, until another one runs through.
        exec("")
    from quasiharmonic.ui.cli.process import finish

    return finish(status)


if __name__ == "__main__":
    raise SystemExit(main())
