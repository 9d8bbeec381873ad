"""Dense RGB-D SLAM whose map is a set of small neural networks; free of ROS."""

__version__ = "0.1.0"
