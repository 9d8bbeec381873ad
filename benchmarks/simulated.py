"""Simulated recordings, made where they are not there yet."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path


def program() -> str:
    """The `meslam` command of this environment."""
    return shutil.which("meslam", path=str(Path(sys.executable).parent)) or "meslam"


def simulated(scene: str, path: Path, *options: str) -> Path:
    """A recording of a scene, by `meslam simulate SCENE --out PATH OPTIONS` if it is missing."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run([program(), "simulate", scene, "--out", str(path), *options], check=True)
    return path
