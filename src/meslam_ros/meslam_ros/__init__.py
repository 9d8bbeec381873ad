"""ROS 2 nodes around `meslam_core`: they subscribe, convert, call the core and publish."""

__version__ = "0.1.0"
