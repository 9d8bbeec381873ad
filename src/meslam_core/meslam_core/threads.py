"""How many threads the numerical libraries may use."""

from __future__ import annotations

import os
import sys


def limit_threads(count: int) -> None:
    """Let one operation of torch, OpenCV and Open3D use at most `count` threads.

    One thread is the fastest on a machine that has other work to do (the threads of one
    operation wait for each other, and the slowest decides), and the only number with which a
    run repeats exactly: with more, the order of summation is a matter of chance.

    Open3D has no setting for it but counts the CPUs it may run on when it is imported. So this
    must come before anything that imports Open3D; later it limits the others alone.
    """
    if "open3d" not in sys.modules and hasattr(os, "sched_setaffinity"):
        available = os.sched_getaffinity(0)
        os.sched_setaffinity(0, sorted(available)[:count])
        try:
            import open3d  # noqa: F401
        finally:
            os.sched_setaffinity(0, available)
    import cv2
    import torch

    cv2.setNumThreads(count)
    torch.set_num_threads(count)
