"""The report of a data set: one HTML page without further files.

The package builds on `ui.batch` and `ui.plot`. Start reading in `page`.
"""

from quasiharmonic.ui.report.page import write_report

__all__ = ["write_report"]
