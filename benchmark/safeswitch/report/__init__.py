"""The report: one page without network, made from a results folder (`safeswitch report`)."""

from safeswitch.report.write import NAME, write_report

__all__ = ["NAME", "write_report"]
