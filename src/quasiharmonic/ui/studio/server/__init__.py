"""The web server of ``qhm studio``, and the worker process that it starts for each browser tab.

The package builds on `ui.studio.session`. Start reading in `server`, then `page_worker`.
"""
