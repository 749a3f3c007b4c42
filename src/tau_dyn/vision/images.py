"""Image files: found in folders, read as grey values, and matched between two cameras; every fault is a sentence."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_MAX_FILE_BYTES = 1 << 30  # bytes of one file
_MAX_PIXELS = 1 << 28  # the largest cameras have 1.5e8


def import_opencv() -> ModuleType:
    """Return OpenCV, which only this room needs.

    Raises:
        InputError: It is not installed.
    """
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(_MAX_PIXELS))  # a small PNG may declare gigabytes
    try:
        import cv2
    except ImportError as fault:
        raise InputError(
            "missing_package", "reading images needs OpenCV; install it with: pip install 'tau_dyn[vision]'"
        ) from fault
    return cv2


def find_images(given: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return image files: those named, and those in folders that are named, in natural order (img2 before img10).

    Raises:
        InputError: A name that does not exist, a folder without images, or nothing given.
    """
    items = [given] if isinstance(given, str | Path) else list(given)
    files: list[Path] = []
    for item in map(Path, items):
        if item.is_dir():
            inside = sorted((p for p in item.iterdir() if p.suffix.lower() in SUFFIXES), key=get_natural_sort_key)
            if not inside:
                raise InputError("file_not_found", f"{item}: the folder has no images ({', '.join(SUFFIXES[:6])})")
            files += inside
        elif item.is_file():
            files.append(item)
        else:
            raise InputError("file_not_found", f"{item}: no such image or folder")
    if not files:
        raise InputError("missing_input", "no images given; name files or a folder")
    return files


def get_natural_sort_key(path: Path) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers in names by value."""
    return [
        (1, int(part), "") if part.isdigit() else (0, 0, part) for part in re.findall(r"\d+|\D+", path.name.lower())
    ]


def read_image(path: Path) -> np.ndarray:
    """Return grey values (height, width) uint8; 16-bit images are scaled to their own range.

    Raises:
        InputError: Not readable, or not an image.
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
    if image.size > _MAX_PIXELS:  # where OpenCV was there before us
        raise InputError("file_format", f"{path}: {image.shape[1]}x{image.shape[0]} pixels; that is no photograph")
    if image.dtype != np.uint8:
        top = max(float(np.nanmax(image)), 1e-9)
        image = np.clip(255.0 * image / top, 0, 255).astype(np.uint8)
    return image


def match_images(cameras: Sequence[Sequence[Path]]) -> list[list[int]]:
    """Return for each camera which moment each of its images shows.

    Images of two cameras belong together by the last number in their names, where these are unique in each camera and shared,
    and by their order where both have as many.

    Raises:
        InputError: Neither holds.
    """
    if len(cameras) == 1:
        return [list(range(len(cameras[0])))]
    numbers = [[_number(path) for path in paths] for paths in cameras]
    if all(None not in n and len(set(n)) == len(n) for n in numbers) and set(numbers[0]) & set(numbers[1]):
        moments = {n: k for k, n in enumerate(dict.fromkeys(x for n in numbers for x in n))}
        return [[moments[n] for n in of] for of in numbers]
    if len({len(paths) for paths in cameras}) == 1:
        return [list(range(len(paths))) for paths in cameras]
    counts = " and ".join(str(len(paths)) for paths in cameras)
    raise InputError(
        "mismatch",
        f"{counts} images of the two cameras cannot be told to belong together; number them alike, as left_001 and right_001",
    )


def _number(path: Path) -> int | None:
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else None
