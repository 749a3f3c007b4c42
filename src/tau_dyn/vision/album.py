"""All images of a campaign: search in folders, reading, matching between cameras, detection of the pattern, checks."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError
from tau_dyn.vision.cameras import Cameras
from tau_dyn.vision.detect import find_corners
from tau_dyn.vision.images import Detection, read_image
from tau_dyn.vision.pattern import Pattern
from tau_dyn.vision.squares import find_squares

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")


def find_images(given: str | Path | Sequence[str | Path]) -> list[Path]:
    """Return the given image files, and those in given folders, in natural order (img2 before img10).

    Raises:
        InputError: A name does not exist, a folder has no images, or no name is given.
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


def match_images(cameras: Sequence[Sequence[Path]]) -> list[list[int]]:
    """Return for each camera the index of the moment that each of its images shows.

    Images of two cameras are matched by the last number in their names if these numbers are unique in each camera and shared,
    or by their order if both cameras have equally many images.

    Raises:
        InputError: Neither condition holds.
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
        f"{counts} images of the two cameras cannot be paired; give pairs the same number, as left_001 and right_001",
    )


def _number(path: Path) -> int | None:
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else None


Images = str | Path | Sequence[str | Path]


@dataclass(frozen=True, eq=False)
class Album:
    """All images, camera by camera.

    Attributes:
        paths: Files.
        moments: Moment that each image shows; two cameras' images of one moment show the same plate.
        found: Detection in each image.
        extra: Whether each image is used only to calibrate the cameras.
        sizes: Width and height of each camera's images (c, 2) [px].
    """

    paths: list[list[Path]]
    moments: list[list[int]]
    found: list[list[Detection]]
    extra: list[list[bool]]
    sizes: np.ndarray

    def name(self, camera: int, k: int) -> str:
        """Return an image's file name, with its folder if it is not of the first camera and another image has the same name."""
        path = self.paths[camera][k]
        alike = sum(other.name == path.name for of in self.paths for other in of) > 1
        aside = camera > 0 or self.extra[camera][k]
        return f"{path.parent.name}/{path.name}" if alike and aside else path.name


def read_album(
    images: Images,
    second: Images | None,
    extra: Images | None,
    second_extra: Images | None,
    pattern: Pattern,
    progress: Callable[[str], None],
) -> Album:
    """Read all images and find the pattern in each; arguments as in `measure_poses_from_images`.

    Raises:
        InputError: Files are not images, are given twice, have mixed sizes, or cannot be matched between cameras.
    """
    given = [(images, extra)] + ([(second, second_extra)] if second is not None else [])
    if second is None and second_extra is not None:
        raise InputError("missing_input", "extra images of a second camera were given, but no images of it")
    main = [find_images(of) for of, _ in given]
    more = [find_images(of) if of is not None else [] for _, of in given]
    _once([*main, *more])
    moments = match_images(main)
    last = max(m for of in moments for m in of) + 1
    if any(more):
        together = match_images(more) if all(more) else [list(range(len(of))) for of in more]
        moments = [a + [last + m for m in b] for a, b in zip(moments, together, strict=True)]
    paths = [a + b for a, b in zip(main, more, strict=True)]
    found, sizes = [], []
    for c, of in enumerate(paths):
        row, size = _detect(of, pattern, f"camera {c + 1}" if len(paths) > 1 else "images", progress)
        found.append(row)
        sizes.append(size)
    extra_ones = [[False] * len(a) + [True] * len(b) for a, b in zip(main, more, strict=True)]
    return Album(paths, moments, found, extra_ones, np.array(sizes))


def _once(lists: list[list[Path]]) -> None:
    every = [path.resolve() for of in lists for path in of]
    if len(set(every)) < len(every):
        twice = next(p for k, p in enumerate(every) if p in every[:k])
        raise InputError(
            "duplicate_name", f"{twice.name} is given twice; every image belongs to one camera and is read once"
        )


def _detect(
    paths: list[Path], pattern: Pattern, what: str, progress: Callable[[str], None]
) -> tuple[list[Detection], tuple[int, int]]:
    out, size = [], (0, 0)
    for k, path in enumerate(paths):
        progress(f"{what}: {k + 1} of {len(paths)}")
        image = read_image(path)
        here = (image.shape[1], image.shape[0])
        if k and here != size:
            raise InputError(
                "mismatch",
                f"{path}: {here[0]}x{here[1]} pixels, but {paths[0].name} has {size[0]}x{size[1]}; "
                "one camera gives images of one size",
            )
        size = here
        out.append(find_corners(image, pattern) if pattern.kind == "chessboard" else find_squares(image, pattern))
    if len(paths) >= MIN_BACKGROUND_IMAGES and any(d.several for d in out):
        progress(f"{what}: background")
        out = _choose_moving(paths, out)
    return out, size


MIN_BACKGROUND_IMAGES = 10
"""Images whose median is the background (thesis 5.5): a moving plate covers no position in half of them."""
_MAX_STILL_CHANGE = 6.0  # grey values: in steady light, means over a plate change less if it does not move


def _choose_moving(paths: list[Path], found: list[Detection]) -> list[Detection]:
    """Return detections in which the plate that differs from the background is chosen among several."""
    some = np.linspace(0, len(paths) - 1, MIN_BACKGROUND_IMAGES).astype(int)
    background = np.median([read_image(paths[k]) for k in some], axis=0)
    out = list(found)
    for k, d in enumerate(found):
        if d.several:
            change = np.abs(read_image(paths[k]) - background)
            moving = [plate for plate in d.several if _average_over(change, plate) > _MAX_STILL_CHANGE]
            if len(moving) == 1:
                which = next(i for i, plate in enumerate(d.several) if plate is moving[0])
                out[k] = Detection(moving[0], stderr=d.several_stderr[which])
    return out


def _average_over(image: np.ndarray, plate: np.ndarray) -> float:
    """Return the mean of an image over the bounding box of a plate's corners (n, 2)."""
    (u0, v0), (u1, v1) = np.floor(plate.min(axis=0)).astype(int), np.ceil(plate.max(axis=0)).astype(int)
    return float(image[v0 : v1 + 1, u0 : u1 + 1].mean())


def check_some(seen: Album, pattern: Pattern) -> None:
    """Reject images if the pattern is not found in any of them; the message names a size that many show instead."""
    every = [d for of in seen.found for d in of]
    if any(d.corners is not None for d in every):
        return
    others = [d.other for d in every if d.other]
    if others and max(map(others.count, others)) >= max(2, len(every) // 2):
        usual = max(set(others), key=others.count)
        raise InputError(
            "not_visible",
            f"no image shows a pattern of {pattern.name} inner corners, but {others.count(usual)} of {len(every)} "
            f"show one of {usual}; is that yours?",
        )
    reason = max({d.reason for d in every}, key=[d.reason for d in every].count)
    raise InputError(
        "not_visible",
        f"not one of the {len(every)} images shows the pattern; {seen.paths[0][0].name}: "
        f"{every[0].reason if len(every) == 1 else reason}",
    )


def check_cameras(cameras: Cameras, seen: Album) -> None:
    """Reject known cameras that do not match the images."""
    if cameras.n != len(seen.paths):
        raise InputError("mismatch", f"the cameras file has {cameras.n} cameras, the images are of {len(seen.paths)}")
    for c, (known, here) in enumerate(zip(cameras.size, seen.sizes, strict=True)):
        if tuple(known) != tuple(here):
            raise InputError(
                "mismatch",
                f"{seen.paths[c][0].name} has {here[0]}x{here[1]} pixels, but camera {c + 1} was calibrated with "
                f"{known[0]}x{known[1]}; calibrate it again with images of this size",
            )
