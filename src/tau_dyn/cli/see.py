"""Measured poses from images of a chessboard plate on the robot, taken by one camera or two; lenses are found along."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from tau_dyn.cli.common import Outcome, add_common, show_progress
from tau_dyn.cli.kinds import positive, read_csv_file_name

HELP = "measured poses from images of a pattern plate"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("images", metavar="IMAGES", nargs="+", help="images of the (first) camera, or folders of them")
    parser.add_argument(
        "--pattern", metavar="9x6", required=True, help="inner corners of the chessboard, columns x rows"
    )
    parser.add_argument(
        "--square", metavar="M", type=positive, required=True, help="side of a square [m]; it gives the scale"
    )
    parser.add_argument("--second", metavar="IMAGES", nargs="+", help="images of a second camera at the same moments")
    parser.add_argument(
        "--positions",
        metavar="Q.csv",
        type=Path,
        help="robot positions q_J, with a column image (file names) or in the images' order",
    )
    lens = parser.add_argument_group("cameras")
    lens.add_argument(
        "--extra",
        metavar="IMAGES",
        nargs="+",
        help="more images of the (first) camera, such as with the plate held by hand, to find its lens",
    )
    lens.add_argument("--second-extra", metavar="IMAGES", nargs="+", help="the same for the second camera")
    lens.add_argument(
        "--lens",
        metavar="MODEL",
        default="brown",
        help="brown (default: k1 k2 p1 p2), brown3 (and k3), radial (k1 k2) or none",
    )
    lens.add_argument(
        "--cameras", metavar="CAMERAS.yaml", type=Path, help="cameras known from before, with their uncertainty"
    )
    lens.add_argument("--save-cameras", metavar="CAMERAS.yaml", type=Path, help="write the cameras found here")
    parser.add_argument(
        "--out", metavar="POSES.csv", type=read_csv_file_name, help="write the poses here, as calibrate reads them"
    )
    add_common(parser)


def run(args: argparse.Namespace) -> Outcome:
    """Measure poses."""
    with show_progress(args.quiet) as step:
        step("loading")
        from tau_dyn.vision import (
            format_cameras_text,
            measure_poses_from_images,
            parse_pattern,
            read_cameras,
            read_positions,
        )

        table = measure_poses_from_images(
            args.images,
            parse_pattern(args.pattern, args.square),
            second=args.second,
            cameras=read_cameras(args.cameras) if args.cameras else None,
            extra=args.extra,
            second_extra=args.second_extra,
            positions=read_positions(args.positions) if args.positions else None,
            lens=args.lens,
            progress=step,
        )
    files: dict[Path, str | Callable[[Path], None]] = {args.out: table.to_csv()} if args.out else {}
    files |= {args.save_cameras: format_cameras_text(table.cameras)} if args.save_cameras else {}
    return Outcome(
        result=table.to_dict(),
        warnings=table.warnings,
        inputs=[*table.inputs, *(path for path in (args.positions, args.cameras) if path)],
        show=lambda console: _show(console, table, args),
        files=files,
    )


def _show(console, table, args: argparse.Namespace) -> None:
    import numpy as np

    total = len(table.inputs)
    stereo = int((table.seen_by > 1).sum())
    seen = f", {stereo} of them seen by both cameras" if table.cameras.n > 1 else ""
    console.print(f"{table.n} poses from {total} images{seen}", markup=False)
    size = 1e3 * np.linalg.norm(table.stderr[:, :3], axis=1)
    turn = np.degrees(np.linalg.norm(table.stderr[:, 3:], axis=1))
    common = 1e3 * np.median(table.common_stderr)
    console.print(
        f"standard error of a pose: {np.median(size):.3g} mm and {np.median(turn):.2g} deg (median), "
        f"largest {size.max():.3g} mm; "
        f"{common:.3g} mm of it common to all poses, through the cameras",
        markup=False,
    )
    for c in range(table.cameras.n):
        f, stderr = table.cameras.intrinsics[c, 0], table.cameras.stderr[9 * c]
        k1 = table.cameras.intrinsics[c, 4]
        console.print(
            f"camera {c + 1}: f = {f:.1f} ± {stderr:.1f} px (± standard error), k1 = {k1:.3f}, corner residual "
            f"{table.rms[c]:.3f} px rms",
            markup=False,
        )
    for what, path in (("poses", args.out), ("cameras", args.save_cameras), ("result", args.json)):
        if path:
            console.print(f"{what}: {path}", markup=False)
