"""How many threads the numerical libraries may use; Open3D, loaded when it is needed."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType
from typing import Any


class LazyOpen3d:
    """The module `open3d`, imported at its first use.

    It takes half a second and 100 MB, and a node may never need it. It has no setting for its
    threads but counts the CPUs that it may run on when it is imported: `threads` of them.
    """

    def __init__(self) -> None:
        self.threads: int | None = None
        self._module: ModuleType | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.load(), name)

    def load(self) -> ModuleType:
        """Import it unless that is done."""
        if self._module is None:
            self._module = self._imported()
        return self._module

    def _imported(self) -> ModuleType:
        if "open3d" in sys.modules or self.threads is None or not hasattr(os, "sched_setaffinity"):
            return importlib.import_module("open3d")
        available = os.sched_getaffinity(0)
        os.sched_setaffinity(0, sorted(available)[: self.threads])
        try:
            return importlib.import_module("open3d")
        finally:
            os.sched_setaffinity(0, available)


open3d = LazyOpen3d()


def limit_threads(count: int, load_open3d: bool = True) -> None:
    """Let one operation of torch, OpenCV and Open3D use at most `count` threads.

    One thread is the fastest on a machine that has other work to do (the threads of one
    operation wait for each other, and the slowest decides), and the only number with which a
    run repeats exactly: with more, the order of summation is a matter of chance.

    Torch is limited where it is loaded already, as all that computes with it does; Open3D where
    it is not, for later it keeps its number.

    Args:
        count: of threads.
        load_open3d: import it now, for code that imports it itself; otherwise `open3d` of this
            module does so when it is needed.
    """
    import cv2

    cv2.setNumThreads(count)
    open3d.threads = count
    if load_open3d:
        open3d.load()
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(count)
