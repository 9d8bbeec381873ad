"""Inputs as files: what a fuzzer found, and what must never fail again."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path

from fuzz.loop import Finding

REGRESSIONS = Path(__file__).with_name("regressions")


def case_name(finding: Finding) -> str:
    """A file name that tells target and error."""
    digest = hashlib.sha256(f"{finding.target} {finding.kind}".encode()).hexdigest()[:8]
    return f"{finding.target.replace(' ', '_')}-{digest}.json"


def write_case(path: Path, finding: Finding) -> None:
    """Write a finding as one JSON file."""
    parts = {name: base64.b64encode(data).decode() for name, data in sorted(finding.parts.items())}
    path.write_text(json.dumps(vars(finding) | {"parts": parts}, indent=1) + "\n")


def read_case(path: Path) -> Finding:
    """The finding in a file."""
    document = json.loads(path.read_text())
    parts = {name: base64.b64decode(text) for name, text in document.pop("parts").items()}
    return Finding(**document, parts=parts)
