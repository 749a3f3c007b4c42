"""`tau-dyn see`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress

_CAMERAS = Group("Cameras")


def see(
    images: tuple[str, ...],
    /,
    *,
    pattern: Annotated[str, Parameter(metavar="9x6")],
    square: Annotated[args.Positive, Parameter(metavar="M")],
    second: Annotated[args.Strings, Parameter(metavar="IMAGES")] = (),
    positions: Annotated[Path | None, Parameter(metavar="Q.csv")] = None,
    extra: Annotated[args.Strings, Parameter(group=_CAMERAS, metavar="IMAGES")] = (),
    second_extra: Annotated[args.Strings, Parameter(group=_CAMERAS, metavar="IMAGES")] = (),
    lens: Annotated[str, Parameter(group=_CAMERAS, metavar="MODEL")] = "brown",
    cameras: Annotated[Path | None, Parameter(group=_CAMERAS, metavar="CAMERAS.yaml")] = None,
    save_cameras: Annotated[Path | None, Parameter(group=_CAMERAS, metavar="CAMERAS.yaml")] = None,
    out: Annotated[
        Path | None, args.build_destination("POSES.csv", "Write the poses here, as calibrate reads them", csv=True)
    ] = None,
    output: args.Output = args.Output(),
) -> Outcome:
    """Measured poses from images of a chessboard plate on the robot, taken by one camera or two; lenses are found along.

    Args:
        images: Images of the (first) camera, or folders of them
        pattern: Inner corners of the chessboard, columns x rows
        square: Side of a square [m]; it gives the scale
        second: Images of a second camera at the same moments
        positions: Robot positions q_J, with a column image (file names) or in the images' order
        extra: More images of the (first) camera, such as with the plate held by hand, to find its lens
        second_extra: The same for the second camera
        lens: Brown (k1 k2 p1 p2), brown3 (and k3), radial (k1 k2) or none
        cameras: Cameras known from before, with their uncertainty
        save_cameras: Write the cameras found here
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.vision import (
            format_cameras_text,
            measure_poses_from_images,
            parse_pattern,
            read_cameras,
            read_positions,
        )

        table = measure_poses_from_images(
            list(images),
            parse_pattern(pattern, square),
            second=list(second) or None,
            cameras=read_cameras(cameras) if cameras else None,
            extra=list(extra) or None,
            second_extra=list(second_extra) or None,
            positions=read_positions(positions) if positions else None,
            lens=lens,
            progress=step,
        )
    return Outcome(
        result=table.to_dict(),
        warnings=table.warnings,
        inputs=[*table.inputs, positions, cameras],
        show=lambda console, written: _show(console, table, written),
        files={out: table.to_csv(), save_cameras: format_cameras_text(table.cameras)},
        named={"poses": out, "cameras": save_cameras},
    )


def _show(console, table, written: dict[str, str]) -> None:
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
    for what, path in written.items():
        console.print(f"{what}: {path}", markup=False)
