"""Looks at the machine, and says what is wrong and how to mend it."""

from meslam_core.doctor.finding import Examination, Finding, Status, fail, ok, warn

__all__ = ["Examination", "Finding", "Status", "fail", "ok", "warn"]
