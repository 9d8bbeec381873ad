"""Make the ROS wheels' CMake files name this virtual environment's include folders.

The wheels' exported targets carry the Python and NumPy include folders of the machine that
built them, so that no interface package would configure here. Safe to run again.
"""

from __future__ import annotations

import re
import sys
import sysconfig
from pathlib import Path

import numpy

PYTHON_INCLUDE = re.compile(r"/opt/python/cp[^/;\"]+/include/python3\.\d+")
NUMPY_INCLUDE = re.compile(
    r"/opt/python/cp[^/;\"]+/lib/python3\.\d+/site-packages/numpy/[\w/]*include"
)


def main() -> int:
    """Rewrite every exported CMake file; 1 where Python's headers are missing."""
    python_include = Path(sysconfig.get_paths()["include"])
    if not (python_include / "Python.h").is_file():
        print(f"{python_include}/Python.h is missing: install python3-dev", file=sys.stderr)
        return 1
    for path in sorted(Path(sys.prefix, "share").glob("*/cmake/*Export.cmake")):
        text = path.read_text()
        patched = NUMPY_INCLUDE.sub(numpy.get_include(), text)
        patched = PYTHON_INCLUDE.sub(python_include.as_posix(), patched)
        if patched != text:
            path.write_text(patched)
    return 0


if __name__ == "__main__":
    sys.exit(main())
