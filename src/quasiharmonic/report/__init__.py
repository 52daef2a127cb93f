"""A run as one page of HTML that needs nothing else to be looked at."""

from quasiharmonic.report.page import write_report

__all__ = ["write_report"]
