"""The browser application ``qhm studio``: a server, one worker process per browser tab, and the shared session logic.

The package builds on `solver` and `apps`. Start reading in `session`, then `server`.
"""
