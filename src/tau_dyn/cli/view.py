"""`tau-dyn view`.

`tau-dyn see`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.exceptions import InputError

_HERE = ("127.0.0.1", "localhost", "::1")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Contents:
    """Contents of the window in addition to the robot, and its address.

    Attributes:
        simulated: The same motion simulated, as a ghost (default: its references)
        columns: Column map of a foreign log
        result: Results to show: --json of diagnose, workspace, accuracy, calibrate, modes, identify
        compute: Compute missing data of a result: points of a workspace, nominal errors
        cloud: Points x y z to show, such as workspace --out writes
        host: Address; 127.0.0.1: this computer only
        port: Port, or the next free one
        no_shadows: Draw no shadows; faster without a graphics card
    """

    simulated: Annotated[Path | None, Parameter(metavar="LOG")] = None
    columns: Annotated[Path | None, Parameter(metavar="MAP.yaml")] = None
    result: Annotated[args.Paths, Parameter(metavar="FILE.json")] = ()
    compute: bool = False
    cloud: Annotated[Path | None, Parameter(metavar="FILE.csv")] = None
    host: Annotated[str, Parameter(metavar="ADDRESS")] = _HERE[0]
    port: Annotated[int, Parameter(validator=args.PORT, converter=args.read_whole)] = 8080
    no_shadows: bool = False


def view(
    robot: args.RobotName,
    log: Path | None = None,
    /,
    *,
    contents: Contents = Contents(),
    seconds: Annotated[args.Positive | None, Parameter(name="--for", metavar="SECONDS")] = None,
    robot_options: args.RobotOptions = args.RobotOptions(),
    output: args.FolderOutput = args.FolderOutput(),
) -> Outcome:
    """The robot in the browser: sliders for its actuated joints, playback of a log, results on the affected parts.

    Args:
        log: A log to play
        seconds: Close after this time
    """
    with show_progress(output.quiet) as step:
        viewer = open_window(robot, log, contents, robot_options, step)
    if contents.host not in _HERE:
        print(f"warning: everybody who reaches {contents.host} can look and move the sliders", file=sys.stderr)
    if not output.quiet:
        screen = sys.stderr if output.json == args.STDOUT else sys.stdout
        print(f"{viewer.robot.name} at {viewer.url}   (Ctrl+C ends it)", file=screen, flush=True)
    viewer.wait(seconds)
    return Outcome(
        result={"url": viewer.url},
        warnings=viewer.warnings,
        inputs=[*robot_options.list_files(robot), log, contents.simulated, *contents.result, contents.cloud],
    )


def open_window(
    robot: str, log: Path | None, contents: Contents, options: args.RobotOptions, step: Callable[[str], None]
):
    """Return the window with all contents that the arguments name; all files are read before it opens."""
    from tau_dyn.log import read_log
    from tau_dyn.view import Viewer, build_playback, read_cloud, read_result

    if contents.simulated and not log:
        raise InputError("bad_option", "--simulated is the ghost of a log; name the log too")
    step("loading")
    machine = options.load(robot)
    playback = None
    if log is not None:
        ghost = None if contents.simulated is None else read_log(contents.simulated)
        recorded = read_log(log, columns=contents.columns)
        machine = options.hold_silent_joints(machine, robot, [recorded])
        playback = build_playback(recorded, machine, ghost)
    step("reading results")
    shown = [c for path in contents.result for c in read_result(path, machine, compute=contents.compute)]
    shown += [] if contents.cloud is None else [read_cloud(contents.cloud)]
    viewer = Viewer(machine, host=contents.host, port=contents.port, shadows=not contents.no_shadows)
    if playback is not None:
        viewer.play(playback)
    viewer.add(shown)
    return viewer


_CAMERAS = Group("Cameras")


def see(
    images: tuple[str, ...],
    /,
    *,
    pattern: Annotated[str, Parameter(metavar="9x6")],
    square: Annotated[args.Positive, Parameter(metavar="M")],
    second: Annotated[args.Strings, Parameter(metavar="IMAGES")] = (),
    positions: Annotated[Path | None, Parameter(metavar="Q.csv")] = None,
    times: Annotated[Path | None, Parameter(metavar="TIMES.csv")] = None,
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
    """Measured poses from images of a plate on the robot, by one camera or two; lenses are calibrated at the same time.

    Args:
        images: Images of the (first) camera, or folders of them
        pattern: Inner corners of the chessboard, columns x rows, or five-squares
        square: Side of a square [m]; it gives the scale
        second: Images of a second camera at the same moments
        positions: Robot positions q_J, with a column image or in the images' order; with --times a log with t
        times: Times t [s] of images of a moving robot, matched like positions
        extra: Images used only to calibrate the lens, with the plate held by hand
        second_extra: Such images of the second camera
        lens: Lens model: brown (k1 k2 p1 p2), brown3 (and k3), radial (k1 k2) or none
        cameras: Known cameras, with uncertainty
        save_cameras: Write the estimated cameras here
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.vision import (
            format_cameras_text,
            measure_poses_from_images,
            parse_pattern,
            read_cameras,
            read_positions,
            read_times,
        )

        table = measure_poses_from_images(
            list(images),
            parse_pattern(pattern, square),
            second=list(second) or None,
            cameras=read_cameras(cameras) if cameras else None,
            extra=list(extra) or None,
            second_extra=list(second_extra) or None,
            positions=read_positions(positions) if positions else None,
            times=read_times(times) if times else None,
            lens=lens,
            progress=step,
        )
    return Outcome(
        result=table.to_dict(),
        warnings=table.warnings,
        inputs=[*table.inputs, positions, times, cameras],
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
        f"{common:.3g} mm of it common to all poses, through the cameras{'' if table.clock is None else ' and the clock'}",
        markup=False,
    )
    if table.clock is not None:
        console.print(
            f"clock: time of the log = time of the images {table.clock.value:+.6g} ± {table.clock.stderr:.2g} s "
            "(± standard error)",
            markup=False,
        )
    if table.speed is not None and np.isfinite(table.speed).any():
        median, top = np.nanmedian(table.speed), np.nanmax(table.speed)
        console.print(f"speed of the plate: {median:.3g} m/s (median), largest {top:.3g}", markup=False)
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
