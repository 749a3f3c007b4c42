"""Images as grey values, and the detection of the pattern in an image."""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes

_MAX_FILE_BYTES = 1 << 30  # bytes of one file
_MAX_PIXELS = 1 << 28  # the largest cameras have 1.5e8


def import_opencv() -> ModuleType:
    """Return OpenCV, which only this package needs.

    Raises:
        InputError: OpenCV is not installed.
    """
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(_MAX_PIXELS))  # a small PNG may declare gigabytes
    try:
        import cv2
    except ImportError as fault:
        raise InputError(
            "missing_package", "reading images needs OpenCV; install it with: pip install 'tau_dyn[vision]'"
        ) from fault
    return cv2


def read_image(path: Path) -> np.ndarray:
    """Return grey values (height, width) uint8; 16-bit images are scaled to their own range.

    Raises:
        InputError: The file is not readable, or not an image.
    """
    cv2 = import_opencv()
    try:
        data = np.frombuffer(read_bytes(path, _MAX_FILE_BYTES), np.uint8)
    except OSError as fault:
        raise InputError("cannot_read", f"{path}: cannot be read ({fault.strerror or fault})") from fault
    try:
        image = (
            cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
            if data.size
            else None
        )
    except cv2.error:
        image = None
    if image is None:
        raise InputError("damaged_file", f"{path}: not an image that can be read; give PNG, JPEG, TIFF or BMP")
    if image.size > _MAX_PIXELS:  # if OpenCV was imported before the limit was set
        raise InputError("file_format", f"{path}: {image.shape[1]}x{image.shape[0]} pixels; that is no photograph")
    if image.dtype != np.uint8:
        top = max(float(np.nanmax(image)), 1e-9)
        image = np.clip(255.0 * image / top, 0, 255).astype(np.uint8)
    return image


class Detection(NamedTuple):
    """Result of the search for the pattern in an image.

    Attributes:
        corners: Corners (n, 2) [px] in the pattern's order, or None if the pattern was not found.
        reason: Reason why it was not found, or ''.
        other: Size of another pattern in the image, or ''.
        stderr: Standard error of each corner, from the grey values (n,) [px].
        several: Corners of each plate (n, 2), if several equal plates were found.
        several_stderr: Their standard errors (n,) [px].
    """

    corners: np.ndarray | None
    reason: str = ""
    other: str = ""
    stderr: np.ndarray | None = None
    several: tuple[np.ndarray, ...] = ()
    several_stderr: tuple[np.ndarray, ...] = ()
