"""Small robots, candidates and devices for the tests of pose choice."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tau_dyn.calibrate import Geometry
from tau_dyn.calibrate.frames import Frame
from tau_dyn.calibrate.poses.automation import build_geometry
from tau_dyn.calibrate.poses.camera import Camera, CameraPattern, build_camera_frame, build_target_frame
from tau_dyn.calibrate.poses.devices import Tracker
from tau_dyn.mechanism import Poses, build_rods, inverse_kinematics
from tau_dyn.robot import Robot, load_robot, load_robot_from_urdf

UP = np.array([0.0, 0.0, 1.0])
MIDDLE = np.array([1.75, -0.6, 0.7])


@lru_cache(maxsize=1)
def l1() -> Robot:
    """Return the L1 prototype with one rod an arm."""
    return load_robot("gantry_tau")


@lru_cache(maxsize=1)
def l1_geometry() -> Geometry:
    """Return its 21 dimensions."""
    return build_geometry(l1())


@lru_cache(maxsize=1)
def candidates() -> np.ndarray:
    """Return positions (N, 3) on a grid over its workspace."""
    axes = [np.linspace(m - w, m + w, n) for m, w, n in zip(MIDDLE, (0.5, 0.45, 0.5), (6, 5, 6), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = inverse_kinematics(build_rods(l1()), Poses(grid, np.repeat(np.eye(3)[None], len(grid), axis=0)))
    return found.q[found.ok]


def at(*places: tuple[float, float, float]) -> Poses:
    """Return tool poses at places, turned as the base."""
    return Poses(np.array(places, float), np.repeat(np.eye(3)[None], len(places), axis=0))


def camera(place: tuple[float, float, float] = (5.5, -0.6, 0.7), **changes) -> Camera:
    """Return a camera in front of L1 that looks at the workspace's middle; the pattern looks along +x."""
    given = {
        "pose": build_camera_frame(np.array(place), MIDDLE, UP),
        "on_tool": build_target_frame(np.array([0.1, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), UP),
        "pattern": CameraPattern(8, 6, 0.04),
        "focal": (1400.0, 1400.0),
        "image": (1280, 960),
        "centre": (639.5, 479.5),
    }
    return Camera(**(given | changes))


def tracker(place: tuple[float, float, float] = (6.0, -0.6, 0.7), **changes) -> Tracker:
    """Return a tracker in front of L1; the reflector looks along +x."""
    on_tool = build_target_frame(np.zeros(3), np.array([1.0, 0.0, 0.0]), UP)
    return Tracker(**({"pose": Frame(np.eye(3), np.array(place)), "on_tool": on_tool} | changes))


def six_axes() -> Robot:
    """Return an industrial arm: axes 2 and 3 parallel, all along z of their frames."""
    places = [("0 0 0.3", "0 0 0"), ("0.1 0 0.1", "1.5708 0 0"), ("0.5 0 0", "0 0 0"),
              ("0.05 0.4 0.02", "-1.5708 0 0"), ("0 0 0.1", "1.5708 0 0"), ("0 0.08 0", "-1.5708 0 0")]  # fmt: skip
    rows = ['<robot name="six"><link name="l0_link"/>']
    for k, (xyz, rpy) in enumerate(places, start=1):
        rows.append(
            f'<link name="l{k}_link"/><joint name="j{k}" type="revolute"><origin xyz="{xyz}" rpy="{rpy}"/>'
            f'<parent link="l{k - 1}_link"/><child link="l{k}_link"/><axis xyz="0 0 1"/>'
            '<limit lower="-2.5" upper="2.5" velocity="2" effort="50"/></joint>'
        )
    rows.append('<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0 0 0.12"/>')
    return load_robot_from_urdf("".join(rows) + '<parent link="l6_link"/><child link="tool"/></joint></robot>', "six")
