"""`meslam report`: one page about one run or several."""

from meslam_core.report.page import write_report
from meslam_core.report.run_folder import RunFolder, read_run

__all__ = ["RunFolder", "read_run", "write_report"]
