"""Packaging of meslam_ros for colcon."""

import os
from pathlib import Path

from setuptools import find_packages, setup

NAME = "meslam_ros"
NODES = (
    "odometry_node",
    "tracking_node",
    "region_manager_node",
    "map_server_node",
    "slam_node",
    "bag_player_node",
    "camera_node",
    "viewer_node",
)
TOOLS = ("call_service",)
# colcon runs a symlink of this file in its build folder: the folders beside the real file count.
PACKAGE_DIR = Path(__file__).resolve().parent
CONFIG_DIRS = (PACKAGE_DIR / "config", PACKAGE_DIR.parents[1] / "config")


def files_in(*folders: Path) -> list[str]:
    """The folders' files, relative to the working folder as setuptools wants data files."""
    return [
        os.path.relpath(path)
        for folder in folders
        for path in sorted(folder.glob("*"))
        if path.is_file()
    ]


setup(
    name=NAME,
    version="0.1.0",
    description="ROS 2 nodes of MeSLAM, dense RGB-D SLAM with neural maps",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", files_in(PACKAGE_DIR / "launch")),
        (f"share/{NAME}/config", files_in(*CONFIG_DIRS)),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [f"{node} = {NAME}.{node}:main" for node in (*NODES, *TOOLS)],
        "meslam.doctor": [f"ROS = {NAME}.doctor:examine_ros"],
    },
)
