"""HTML report of a batch run, in one file.

The package builds on `ui.batch` and `ui.plot`. Start reading in `page`.
"""

from quasiharmonic.ui.report.page import write_report

__all__ = ["write_report"]
