"""Every robot of `urdf/` at home as a picture, drawn by the viewer in headless Chromium (software rendering).

    python experiments/draw_robots.py [--out docs/figures/robots] [--only delta h4]

Writes one PNG a robot. Grey: frame, blue: driven, dark: rods, orange: plate; axes: the tool's x (red), y (green), z (blue). Needs
the extra `view`, Pillow and a Chromium on the path.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any

import numpy as np
from chromium import Page, find_chromium

from tau_dyn.files import write_atomically
from tau_dyn.robot import Robot, list_robot_names, load_robot
from tau_dyn.view import Placer, build_furniture
from tau_dyn.view.scene import RobotFigure, add_floor, compute_outline, convert_pose, light_scene

WIDTH, HEIGHT, FOV = 600, 450, 0.5
MARGIN = 1.1
VIEWS = {
    "gantry_tau_f1": (-40, 14),
    "gantry_tau_queensland": (-60, 30),
    "gantry_tau_t2": (-60, 26),
    "gantry_tau_5dof": (-60, 26),
    "h4": (-65, 16),
    "hexaglide": (-62, 24),
    "hexarot": (-35, 22),
    "linear_axis": (-60, 25),
    "parallelogram": (-75, 10),
    "scara_tau": (-38, 24),
    "stewart": (-70, 18),
}
USUAL = (-62, 20)
VARIANTS = {"gantry_tau": {"arms": "complete"}}
"""Azimuth and elevation in degrees, and arguments, where they are not the usual ones."""


def draw(server: Any, client: Any, robot: Robot, azimuth: float, elevation: float) -> bytes:
    """Return a robot at home as PNG."""
    server.scene.reset()
    server.scene.world_axes.visible = False
    server.scene.set_up_direction("+z")
    light_scene(server.scene, shadows=True)
    place = Placer(robot, build_furniture(robot))
    placed = place(robot.home)
    RobotFigure(server.scene, "robot", place.shapes).move(placed)
    corners = compute_outline(place.shapes, placed)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if place.tool is not None:
        length = 0.07 * float(np.linalg.norm(high - low))
        corners = np.vstack([corners, place.tool.translation + length * np.vstack([np.eye(3), -np.eye(3)])])
        axes = server.scene.add_frame("/tool", axes_length=length, axes_radius=0.04 * length)
        axes.position, axes.wxyz = convert_pose(place.tool)
    add_floor(server.scene, low, high)
    position, wxyz = camera(corners, azimuth, elevation)
    server.flush()
    client.get_render(HEIGHT // 10, WIDTH // 10, position=position, wxyz=wxyz, fov=FOV, timeout=120)  # all has arrived
    image = client.get_render(HEIGHT, WIDTH, position=position, wxyz=wxyz, fov=FOV, transport_format="png", timeout=120)
    return packed(image)


def camera(points: np.ndarray, azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) [m] and quaternion w x y z of a camera that sees points (n, 3); it looks along its z, y is down."""
    import pinocchio as pin

    a, e = np.deg2rad([azimuth, elevation])
    forward = -np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    axes = np.column_stack([right, np.cross(forward, right), forward])
    local = points @ axes
    middle = (local.min(axis=0) + local.max(axis=0)) / 2
    local = local - middle
    tall = np.tan(FOV / 2)
    wide = tall * WIDTH / HEIGHT
    back = MARGIN * np.max(np.maximum(np.abs(local[:, 0]) / wide, np.abs(local[:, 1]) / tall) - local[:, 2])
    x, y, z, w = pin.Quaternion(axes).coeffs()
    return axes @ middle - back * forward, np.array([w, x, y, z])


def packed(image: np.ndarray) -> bytes:
    """Return an image (h, w, 3 or 4) as a small PNG of at most 256 colours, on white."""
    from PIL import Image

    layer = Image.fromarray(image).convert("RGBA")
    page = Image.alpha_composite(Image.new("RGBA", layer.size, "white"), layer).convert("RGB")
    out = io.BytesIO()
    page.quantize(256, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()


def main() -> None:
    """Draw them all."""
    import viser

    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "figures" / "robots")
    parser.add_argument("--only", nargs="*", help="short names; all without it")
    given = parser.parse_args()
    if find_chromium() is None:
        parser.error("no chromium on the path")
    server = viser.ViserServer(host="127.0.0.1", port=8180, verbose=False)
    page = Page(f"http://127.0.0.1:{server.get_port()}", WIDTH, HEIGHT)
    try:
        while not server.get_clients():
            page.wait(0.5)
        client = next(iter(server.get_clients().values()))
        for name in given.only or list_robot_names():
            robot = load_robot(name, **VARIANTS.get(name, {}))
            path = given.out / f"{name}.png"
            picture = draw(server, client, robot, *VIEWS.get(name, USUAL))
            with write_atomically(path) as temporary:
                temporary.write_bytes(picture)
            print(f"{path}: {path.stat().st_size // 1024} kB", flush=True)
    finally:
        page.close()
        server.stop()


if __name__ == "__main__":
    main()
