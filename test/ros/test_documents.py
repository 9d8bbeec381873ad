from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from meslam_ros import topics

ROOT = Path(__file__).resolve().parents[2]
DOCUMENT = (ROOT / "docs" / "interfaces.md").read_text()
NAMES = {name: value for name, value in vars(topics).items() if name.isupper()}


@pytest.mark.parametrize("name", sorted(NAMES))
def test_every_topic_and_service_is_documented(name: str) -> None:
    assert f"`{NAMES[name].replace('~', 'bag_player_node')}`" in DOCUMENT


def test_parameters_of_the_nodes_are_documented_as_they_are() -> None:
    check = [sys.executable, str(ROOT / "tools" / "node_parameters.py"), "--check"]
    result = subprocess.run(check, check=False)
    assert result.returncode == 0, "run: python tools/node_parameters.py"
