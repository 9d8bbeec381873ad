"""The camera's image as the page needs it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

IMAGE_WIDTH = 320


def reduced(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image (H, W, 3) no wider than the page needs."""
    height, width = image.shape[:2]
    if width <= IMAGE_WIDTH:
        return image
    size = (IMAGE_WIDTH, max(1, round(height * IMAGE_WIDTH / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
