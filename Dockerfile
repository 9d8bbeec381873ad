# MeSLAM on the official ROS 2 Jazzy image, made by the same set-up as on any machine.
#
#   docker build -t meslam .
#   docker run --rm -it --net=host --ipc=host meslam
#   docker run --rm -it --net=host --ipc=host --device=/dev/bus/usb meslam \
#     ros2 launch meslam_ros meslam.launch.py camera:=meslam
#
# Maps and exports are written below the working folder: add -v "$PWD:/data" -w /data to keep them.
FROM ros:jazzy-ros-base

RUN apt-get update \
    && apt-get install -y --no-install-recommends make ros-jazzy-tf2-msgs \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /meslam
COPY . .
RUN make setup && rm -rf "$HOME/.cache" /var/lib/apt/lists/*

ENTRYPOINT ["/bin/bash", "-c", "source /meslam/env.bash && exec \"$@\"", "meslam"]
CMD ["ros2", "run", "meslam_ros", "slam_node"]
