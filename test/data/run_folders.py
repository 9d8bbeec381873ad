"""Copies of a run's results that a test may change."""

from __future__ import annotations

import json
import shutil
from pathlib import Path


def copied_run(source: Path, target: Path, **entries: object) -> Path:
    """A copy of a run's folder with other entries in its report.json."""
    shutil.copytree(source, target)
    report = json.loads((target / "report.json").read_text()) | entries
    (target / "report.json").write_text(json.dumps(report))
    return target
