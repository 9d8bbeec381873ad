"""Which of a bag's topics carry the colour images, the depth images and their intrinsics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields

from meslam_core.errors import ConfigError, RecordingError
from meslam_core.recordings.images import COLOR_ENCODINGS, DEPTH_ENCODINGS

IMAGE_TYPE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE_TYPE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"

_TRANSPORTS = ("/compressedDepth", "/compressed")


@dataclass(frozen=True)
class RecordingTopics:
    """Names of the topics to read; None means that the recording's content decides.

    Attributes:
        color, depth: sensor_msgs Image or CompressedImage.
        color_info, depth_info: sensor_msgs CameraInfo; by default `camera_info` beside the images.
    """

    color: str | None = None
    depth: str | None = None
    color_info: str | None = None
    depth_info: str | None = None

    @classmethod
    def from_texts(cls, texts: Sequence[str]) -> RecordingTopics:
        """Read `role=topic` texts, the later ones winning.

        Raises:
            ConfigError: when one is not of that form, or there is no such role.
        """
        roles = [field.name for field in fields(cls)]
        named = dict(text.partition("=")[::2] for text in texts)
        if wrong := [role for role, topic in named.items() if role not in roles or not topic]:
            raise ConfigError(
                f"{wrong[0]!r} names no topic; write ROLE=TOPIC with one of {', '.join(roles)}, "
                "such as color=/camera/color/image_raw"
            )
        return cls(**named)


@dataclass(frozen=True)
class ChosenTopics:
    """The topics that are read; an info is None where the recording has none."""

    color: str
    depth: str
    color_info: str | None
    depth_info: str | None


@dataclass(frozen=True)
class ImageTopic:
    """A topic with images, and what its first message says of them."""

    name: str
    encoding: str
    """`encoding` of an Image, the first word of a CompressedImage's `format`."""
    compressed: bool

    @property
    def is_depth(self) -> bool:
        if self.name.endswith("/compressedDepth"):
            return True
        certain = self.encoding in DEPTH_ENCODINGS and self.encoding != "mono16"
        return certain or (self.encoding in DEPTH_ENCODINGS and "depth" in self.name)

    @property
    def is_color(self) -> bool:
        # A JPEG may lack the encoding in its format; depth is never a JPEG.
        known = self.encoding in COLOR_ENCODINGS or (self.compressed and not self.is_depth)
        return known and "depth" not in self.name.removesuffix("/compressedDepth")


def choose_topics(
    name: str,
    images: list[ImageTopic],
    types: Mapping[str, str],
    wanted: RecordingTopics,
) -> ChosenTopics:
    """Choose a colour and a depth topic, and the camera infos beside them.

    realsense2_camera's names win, then depth that is registered to colour, then what is called
    colour rather than infrared, and raw images before compressed ones.

    Args:
        name: of the recording, for messages.
        images: the image topics that have messages.
        types: all topics that have messages, and their types.
        wanted: what the user asked for.

    Raises:
        RecordingError: when a topic is not there, or several fit equally well.
    """
    color = wanted.color or _best(
        name, "colour", [topic for topic in images if topic.is_color], _color_score, images
    )
    depth = wanted.depth or _best(
        name, "depth", [topic for topic in images if topic.is_depth], _depth_score, images
    )
    known = {topic.name for topic in images}
    for option, topic in (("colour", color), ("depth", depth)):
        if topic not in known:
            raise RecordingError(
                f"{name} has no images on the {option} topic {topic}; {_listing(images)}"
            )
    if color == depth:
        raise RecordingError(f"{name}: {color} cannot be both colour and depth; {_listing(images)}")
    for info in (wanted.color_info, wanted.depth_info):
        if info is not None and types.get(info) != CAMERA_INFO_TYPE:
            infos = sorted(topic for topic, kind in types.items() if kind == CAMERA_INFO_TYPE)
            raise RecordingError(
                f"{name} has no camera info on the topic {info}; "
                f"it has: {', '.join(infos) or 'none'}"
            )
    return ChosenTopics(
        color,
        depth,
        wanted.color_info or _info_beside(color, types),
        wanted.depth_info or _info_beside(depth, types),
    )


def _best(
    name: str,
    kind: str,
    candidates: list[ImageTopic],
    score: Callable[[ImageTopic], tuple[bool, ...]],
    images: list[ImageTopic],
) -> str:
    if not candidates:
        raise RecordingError(
            f"{name} has no {kind} images; {_listing(images)}. "
            f"If it is one of them, name it: --topic {_role(kind)}=TOPIC"
        )
    ranked = sorted(candidates, key=score, reverse=True)
    best = [topic for topic in ranked if score(topic) == score(ranked[0])]
    if len(best) > 1:
        raise RecordingError(
            f"{name} has several {kind} topics: {', '.join(topic.name for topic in best)}; "
            f"name the one to use: --topic {_role(kind)}={best[0].name}"
        )
    return best[0].name


def _role(kind: str) -> str:
    """The name of what a person calls colour or depth."""
    return "color" if kind == "colour" else kind


def _color_score(topic: ImageTopic) -> tuple[bool, ...]:
    return (
        topic.name.startswith("/camera/camera/color/"),
        topic.name.startswith(("/camera/color/", "/camera/rgb/")),
        "infra" not in topic.name and not topic.encoding.startswith(("mono", "8UC1")),
        "color" in topic.name or "rgb" in topic.name,
        not topic.compressed,
        "rect" in topic.name,
    )


def _depth_score(topic: ImageTopic) -> tuple[bool, ...]:
    return (
        topic.name.startswith("/camera/camera/aligned_depth_to_color/"),
        "aligned_depth" in topic.name or "depth_registered" in topic.name,
        topic.name.startswith("/camera/"),
        not topic.compressed,
        topic.name.endswith("/compressedDepth"),
        "rect" in topic.name,
    )


def _info_beside(image_topic: str, types: Mapping[str, str]) -> str | None:
    for transport in _TRANSPORTS:
        image_topic = image_topic.removesuffix(transport)
    info = image_topic.rpartition("/")[0] + "/camera_info"
    return info if types.get(info) == CAMERA_INFO_TYPE else None


def _listing(images: list[ImageTopic]) -> str:
    listed = ", ".join(f"{topic.name} ({topic.encoding or 'compressed'})" for topic in images)
    return f"its image topics are: {listed or 'none'}"
