# MeSLAM on the official ROS 2 Jazzy image, made by the same set-up as on any machine.
#
#   docker build -t meslam .
#   docker run --rm -it --net=host --ipc=host --device=/dev/bus/usb meslam
FROM ros:jazzy-ros-base

RUN apt-get update \
    && apt-get install -y --no-install-recommends make ros-jazzy-tf2-msgs \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /meslam
COPY . .
RUN make setup && rm -rf "$HOME/.cache" /var/lib/apt/lists/*

ENTRYPOINT ["/bin/bash", "-c", "source /meslam/env.bash && exec \"$@\"", "meslam"]
CMD ["ros2", "run", "meslam_ros", "slam_node"]
