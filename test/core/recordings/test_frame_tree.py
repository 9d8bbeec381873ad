from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from meslam_core.recordings import transforms
from meslam_core.recordings.transforms import FrameTree


def message(parent: str, child: str, x: float = 1.0) -> SimpleNamespace:
    """A TFMessage with one transform."""
    place = SimpleNamespace(x=x, y=0.0, z=0.0)
    turn = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    transform = SimpleNamespace(
        header=SimpleNamespace(frame_id=parent),
        child_frame_id=child,
        transform=SimpleNamespace(translation=place, rotation=turn),
    )
    return SimpleNamespace(transforms=[transform])


def test_frames_are_connected_along_and_against_the_tree() -> None:
    tree = FrameTree()
    tree.add(message("base", "mount"))
    tree.add(message("/mount", "camera", 2.0))
    there, back = tree.lookup("base", "camera"), tree.lookup("camera", "base")
    assert there is not None
    assert back is not None
    np.testing.assert_allclose(there[:3, 3], [3.0, 0.0, 0.0])
    np.testing.assert_allclose(back[:3, 3], [-3.0, 0.0, 0.0])
    assert tree.lookup("base", "elsewhere") is None


def test_frames_beyond_the_limit_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transforms, "MAX_FRAMES", 3)
    tree = FrameTree()
    for child in ("mount", "camera", "one_too_many"):
        tree.add(message("base", child))
    assert "camera" in tree
    assert "one_too_many" not in tree
    tree.add(message("base", "mount", 5.0))
    moved = tree.lookup("base", "mount")
    assert moved is not None, "what is known may change"
    assert moved[0, 3] == 5.0
