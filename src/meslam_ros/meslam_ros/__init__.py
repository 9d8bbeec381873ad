"""ROS 2 nodes of MeSLAM: each subscribes, converts, calls `meslam_core` and publishes."""

import os

# Libraries that open a thread a core fight with the other nodes over the cores; this must be said
# before any of them is loaded.
os.environ.setdefault("OMP_NUM_THREADS", "1")
