"""Pixels of image messages in every encoding."""

from __future__ import annotations

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from meslam_core.errors import RecordingError
from meslam_core.recordings.images import (
    color_from_message,
    decode_color,
    decode_depth,
    depth_from_message,
)

RGB = np.random.default_rng(1).integers(0, 256, (6, 8, 3)).astype(np.uint8)
DEPTH_MM = np.random.default_rng(2).integers(0, 5000, (6, 8)).astype(np.uint16)


def image(pixels: np.ndarray, encoding: str, padding: int = 0, **fields: int) -> SimpleNamespace:
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    message = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": 0,
        "step": rows.shape[1],
        "data": rows.reshape(-1),
    }
    return SimpleNamespace(**message | fields)


def compressed(description: str, data: bytes) -> SimpleNamespace:
    return SimpleNamespace(format=description, data=np.frombuffer(data, np.uint8))


def png(pixels: np.ndarray) -> bytes:
    return bytes(cv2.imencode(".png", pixels)[1].tobytes())


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("rgba8", np.dstack([RGB, np.full(RGB.shape[:2], 7, np.uint8)])),
        ("bgra8", np.dstack([RGB[..., ::-1], np.full(RGB.shape[:2], 7, np.uint8)])),
    ],
)
def test_colour_encodings(encoding: str, pixels: np.ndarray, padding: int) -> None:
    np.testing.assert_array_equal(color_from_message(image(pixels, encoding, padding)), RGB)


def test_grey_becomes_equal_channels() -> None:
    color = color_from_message(image(RGB[..., 0], "mono8"))
    np.testing.assert_array_equal(color, np.repeat(RGB[..., :1], 3, axis=-1))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422_yuy2", (0, 1)), ("yuv422", (1, 0))])
def test_yuv_keeps_luma_in_its_place(encoding: str, order: tuple[int, int]) -> None:
    luma = np.tile(np.array([16, 235], np.uint8), (4, 4))
    pair = (luma, np.full_like(luma, 128))
    color = color_from_message(image(np.dstack([pair[i] for i in order]), encoding))
    assert (color[:, ::2] <= 1).all()
    assert (color[:, 1::2] >= 254).all()


@pytest.mark.parametrize("padding", [0, 6])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "Z16"])
def test_depth_of_16_bits(encoding: str, padding: int) -> None:
    depth = depth_from_message(image(DEPTH_MM, encoding, padding))
    np.testing.assert_array_equal(depth, DEPTH_MM)
    assert depth.dtype == np.uint16


def test_big_endian_depth() -> None:
    depth = depth_from_message(image(DEPTH_MM.astype(">u2"), "16UC1", is_bigendian=1))
    np.testing.assert_array_equal(depth, DEPTH_MM)
    assert depth.dtype.isnative


def test_depth_of_floats() -> None:
    metres = DEPTH_MM.astype(np.float32) / 1000
    np.testing.assert_array_equal(depth_from_message(image(metres, "32FC1", 4)), metres)


def test_compressed_colour() -> None:
    message = compressed("rgb8; png compressed bgr8", png(RGB[..., ::-1]))
    np.testing.assert_array_equal(color_from_message(message), RGB)


def test_compressed_depth_of_16_bits() -> None:
    header = struct.pack("<iff", 0, 0.0, 0.0)
    message = compressed("16UC1; compressedDepth png", header + png(DEPTH_MM))
    np.testing.assert_array_equal(depth_from_message(message), DEPTH_MM)


def test_compressed_depth_of_floats_is_inverse_depth() -> None:
    metres = np.linspace(0.5, 9.0, 48, dtype=np.float32).reshape(6, 8)
    # As compressed_depth_image_transport encodes: quantised inverse depth up to depth_max.
    quantization, depth_max = 100.0, 10.0
    quant_a = quantization * (quantization + 1.0)
    quant_b = 1.0 - quant_a / depth_max
    inverse = np.rint(quant_a / metres + quant_b).astype(np.uint16)
    inverse[0, 0] = 0
    data = struct.pack("<iff", 0, quant_a, quant_b) + png(inverse)
    depth = depth_from_message(compressed("32FC1; compressedDepth png", data))
    assert depth[0, 0] == 0
    # Half a step of inverse depth: z^2 / (2 A).
    assert depth.dtype == np.float32
    error = np.abs(depth - metres).reshape(-1)[1:]
    assert (error <= metres.reshape(-1)[1:] ** 2 / (2 * quant_a) + 1e-4).all()


def test_wrong_encodings_are_named() -> None:
    with pytest.raises(RecordingError, match=r"encoding 'bayer_rggb8'; expected one of .*rgb8"):
        color_from_message(image(RGB[..., 0], "bayer_rggb8"))
    with pytest.raises(RecordingError, match=r"encoding 'rgb8'; expected one of .*16UC1"):
        depth_from_message(image(RGB, "rgb8"))
    with pytest.raises(RecordingError, match=r"compressedDepth rvl.*only PNG"):
        depth_from_message(compressed("16UC1; compressedDepth rvl", b"123"))


def test_short_and_damaged_images_are_errors() -> None:
    message = image(RGB, "rgb8")
    message.data = message.data[:-10]
    with pytest.raises(RecordingError, match="8x6 rgb8 image has 134 bytes"):
        color_from_message(message)
    for data in (b"", b"no image", png(RGB)[:60]):
        with pytest.raises(RecordingError, match="damaged"):
            decode_color(data)
    with pytest.raises(RecordingError, match="uint8 pixels"):
        decode_depth(png(RGB))


@pytest.mark.parametrize("empty", [{"width": 0}, {"height": 0}, {"width": 0, "height": 0}])
def test_images_without_pixels_are_errors(empty: dict[str, int]) -> None:
    with pytest.raises(RecordingError, match="no pixels"):
        color_from_message(image(RGB, "rgb8", **empty, step=0, data=np.empty(0, np.uint8)))
    with pytest.raises(RecordingError, match="no pixels"):
        depth_from_message(image(DEPTH_MM, "16UC1", **empty))


def test_an_odd_width_cannot_be_yuv() -> None:
    with pytest.raises(RecordingError, match="7 pixels wide"):
        color_from_message(image(RGB[:, :7, :2].copy(), "yuv422"))
