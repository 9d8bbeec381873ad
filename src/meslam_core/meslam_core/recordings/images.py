"""Pixels of ROS image messages and of image files."""

from __future__ import annotations

import io
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from meslam_core.camera import MAX_PIXELS
from meslam_core.errors import RecordingError

Pixels = NDArray[Any]

IMAGE_FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TIFF")

_PNG_SIGNATURE = b"\x89PNG"
_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")

_COLOR_CONVERSIONS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
}
_DEPTH_TYPES = {"16UC1": "u2", "mono16": "u2", "Z16": "u2", "z16": "u2", "32FC1": "f4"}

COLOR_ENCODINGS = frozenset(_COLOR_CONVERSIONS)
DEPTH_ENCODINGS = frozenset(_DEPTH_TYPES)


def color_from_message(message: Any) -> NDArray[np.uint8]:
    """RGB pixels (H, W, 3) uint8 of a sensor_msgs Image or CompressedImage.

    Raises:
        RecordingError: for an encoding that is not colour, or too little data.
    """
    if hasattr(message, "format"):
        return decode_color(bytes(message.data))
    rows = _rows(message, np.dtype(np.uint8), _conversion(message.encoding)[0])
    return to_rgb(rows.reshape(message.height, message.width, -1), message.encoding)


def to_rgb(pixels: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """A new RGB image (H, W, 3) out of pixels (H, W, bytes a pixel) in a ROS encoding.

    Raises:
        RecordingError: when the encoding is not colour, or has another number of bytes.
    """
    channels, conversion = _conversion(encoding)
    if pixels.ndim != 3 or pixels.shape[2] != channels:
        raise RecordingError(
            f"colour image has the shape {pixels.shape}, expected {channels} bytes a pixel "
            f"for {encoding}"
        )
    if channels == 2 and pixels.shape[1] % 2:
        raise RecordingError(
            f"{encoding} image is {pixels.shape[1]} pixels wide, but two of them share a colour"
        )
    return pixels.copy() if conversion is None else _as_uint8(cv2.cvtColor(pixels, conversion))


def _conversion(encoding: str) -> tuple[int, int | None]:
    if encoding not in _COLOR_CONVERSIONS:
        raise RecordingError(
            f"colour image has the encoding {encoding!r}; "
            f"expected one of {', '.join(sorted(COLOR_ENCODINGS))}"
        )
    return _COLOR_CONVERSIONS[encoding]


def depth_from_message(message: Any) -> Pixels:
    """Depth values (H, W) of a sensor_msgs Image or CompressedImage.

    Returns:
        uint16 in the units of the camera (REP-118: millimetres) or float32 in metres.

    Raises:
        RecordingError: for an encoding that is not depth, or too little data.
    """
    if hasattr(message, "format"):
        return _decode_compressed_depth(message.format, bytes(message.data))
    if message.encoding not in _DEPTH_TYPES:
        raise RecordingError(
            f"depth image has the encoding {message.encoding!r}; "
            f"expected one of {', '.join(sorted(DEPTH_ENCODINGS))}"
        )
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + _DEPTH_TYPES[message.encoding])
    return _rows(message, dtype, 1).astype(dtype.newbyteorder("="), copy=True)


def _rows(message: Any, dtype: np.dtype[Any], channels: int) -> Pixels:
    """The rows of an Image, (height, width * channels), without their padding."""
    if not message.width or not message.height:
        raise RecordingError(f"{message.width}x{message.height} image has no pixels")
    used = message.width * channels * dtype.itemsize
    # Some drivers leave `step` at zero; then rows are contiguous.
    step = message.step or used
    if step < used or len(message.data) < step * (message.height - 1) + used:
        raise RecordingError(
            f"{message.width}x{message.height} {message.encoding} image has {len(message.data)} "
            f"bytes in rows of {step}, expected rows of at least {used}; the image is damaged"
        )
    data = np.frombuffer(message.data, np.uint8)[: step * message.height]
    if len(data) < step * message.height:
        # The last row may come without its padding.
        data = np.pad(data, (0, step * message.height - len(data)))
    rows = data.reshape(message.height, step)[:, :used]
    return np.ascontiguousarray(rows).view(dtype)


def _decode_compressed_depth(format_description: str, data: bytes) -> Pixels:
    """Decode compressed_depth_image_transport's PNG: 16UC1, or 32FC1 as quantised inverse depth."""
    if "rvl" in format_description.lower():
        raise RecordingError(
            f"depth is compressed as {format_description!r}; only PNG compression is supported, "
            "record the raw depth topic or set the transport's format to png"
        )
    start = 0 if data.startswith(_PNG_SIGNATURE) else _COMPRESSED_DEPTH_HEADER.size
    raw = decode_depth(data[start:])
    if not format_description.startswith("32FC1") or start == 0:
        return raw
    _, quant_a, quant_b = _COMPRESSED_DEPTH_HEADER.unpack_from(data)
    # depth = A / (raw - B), compressed_depth_image_transport/codec.cpp; raw 0 is no measurement.
    with np.errstate(divide="ignore"):
        depth = quant_a / (raw.astype(np.float32) - np.float32(quant_b))
    return np.where(raw > 0, depth, 0.0).astype(np.float32)


def decode_color(data: bytes) -> NDArray[np.uint8]:
    """RGB pixels (H, W, 3) of a JPEG, PNG or other image file's bytes.

    Raises:
        RecordingError: when the bytes are not an image, or a truncated one.
    """
    return _as_uint8(_decode(data, cv2.IMREAD_COLOR_RGB))


def decode_depth(data: bytes) -> Pixels:
    """Depth values (H, W) of a 16-bit PNG or 32-bit TIFF file's bytes.

    Raises:
        RecordingError: when the bytes are not a one-channel depth image.
    """
    pixels = _decode(data, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 2 or pixels.dtype not in (np.uint16, np.float32):
        raise RecordingError(
            f"depth image has {pixels.dtype} pixels of shape {pixels.shape}; "
            "expected one channel of 16-bit integers or 32-bit floats"
        )
    return pixels


def _decode(data: bytes, flags: int) -> Pixels:
    damaged = f"image data ({len(data)} bytes) is damaged or of an unknown format"
    try:
        with Image.open(io.BytesIO(data), formats=IMAGE_FORMATS) as header:
            width, height = header.size
    # Only the header is read, but its parsers let all kinds of errors through.
    except Exception as error:
        raise RecordingError(damaged) from error
    if width * height > MAX_PIXELS:
        raise RecordingError(f"a {width}x{height} image is larger than any camera's")
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise RecordingError(damaged) from error
    if pixels is None:
        raise RecordingError(damaged)
    return pixels


def _as_uint8(pixels: Pixels) -> NDArray[np.uint8]:
    return pixels.astype(np.uint8, copy=False)
