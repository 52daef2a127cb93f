"""The page ``qhm studio``: a server, one worker process per browser tab, and the session that they share.

The package builds on `solver` and `apps`. Start reading in `session`, then `server`.
"""
