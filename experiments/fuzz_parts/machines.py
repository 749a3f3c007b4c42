"""Random machines with loops, what they record when nothing is wrong, and what of it somebody keeps.

Up to twelve joints: open arms whose joints all are driven, and arms of a drive and three free hinges whose tip a ball ties to the
ground or to another arm: each loop takes away as much freedom as its hinges have. Logs are the model's own forces along a motion
within its limits, without noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import numpy as np
from scipy.spatial.transform import Rotation

from tau_dyn.identify import build_model
from tau_dyn.log import Log
from tau_dyn.model import Model
from tau_dyn.robot import Robot, load_robot_from_urdf
from tau_dyn.simulate import build_named_motion

MAX_JOINTS = 12
_FREE = 3
"""Hinges that one ball takes the freedom of."""
_WORST_CONDITION = 8.0
"""Of a loop at home; a machine close to a singular position can hardly move."""


@dataclass(frozen=True)
class _Joint:
    """One joint with the link that it carries."""

    kind: str
    xyz: np.ndarray
    rpy: np.ndarray
    axis: np.ndarray


@dataclass(frozen=True)
class _Place:
    """A link with its frame in the world when all joints are at zero."""

    link: str = "base_link"
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def beyond(self, link: str, joint: _Joint) -> _Place:
        """Return the place of the link that a joint carries."""
        turned = self.rotation @ Rotation.from_euler("xyz", joint.rpy).as_matrix()
        return _Place(link, turned, self.origin + self.rotation @ joint.xyz)


class _Writer:
    """Writes a machine joint by joint."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.parts, self.n = rng, ['<link name="base_link"/>'], 0
        self.places = [_Place()]

    def draw(self, kinds: Sequence[str]) -> _Joint:
        """Return a joint at a random place."""
        rng = self.rng
        axis = rng.normal(size=3)
        return _Joint(
            str(rng.choice(kinds)),
            rng.uniform(-0.4, 0.4, 3),
            rng.uniform(-np.pi, np.pi, 3),
            axis / np.linalg.norm(axis),
        )

    def add(self, parent: _Place, joint: _Joint, driven: bool) -> _Place:
        """Write a joint and its link with a random body."""
        self.n += 1
        name, link, half = f"{'motor' if driven else 'hinge'}{self.n}", f"part{self.n}_link", 0.3 if driven else 1.5
        mass, centre = self.rng.uniform(0.5, 5), self.rng.uniform(-0.1, 0.1, 3)
        ixx, iyy, izz = mass * 0.02 * self.rng.uniform(0.7, 1.0, 3)
        self.parts.append(
            f'<link name="{link}"><inertial><origin xyz="{_text(centre)}"/><mass value="{mass:.6g}"/>'
            f'<inertia ixx="{ixx:.6g}" iyy="{iyy:.6g}" izz="{izz:.6g}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{name}" type="{joint.kind}"><parent link="{parent.link}"/><child link="{link}"/>'
            f'<origin xyz="{_text(joint.xyz)}" rpy="{_text(joint.rpy)}"/><axis xyz="{_text(joint.axis)}"/>'
            f'<limit lower="{-half}" upper="{half}" velocity="2" effort="500"/></joint>'
        )
        if driven:
            self.parts.append(f'<transmission name="{name}_drive"><joint name="{name}"/></transmission>')
        self.places.append(parent.beyond(link, joint))
        return self.places[-1]

    def add_loop(self, other: _Place) -> None:
        """Write an arm from the ground to another link: a drive, free hinges, a ball."""
        while True:
            joints = [self.draw(("revolute", "prismatic")), *(self.draw(("revolute",)) for _ in range(_FREE))]
            local, places = self.rng.uniform(-0.3, 0.3, 3), [_Place()]
            for joint in joints:
                places.append(places[-1].beyond("", joint))
            tip = places[-1].origin + places[-1].rotation @ local
            moved = [np.cross(p.rotation @ j.axis, tip - p.origin) for p, j in zip(places[2:], joints[1:], strict=True)]
            if np.linalg.cond(np.array(moved)) < _WORST_CONDITION:
                break
        end = self.places[0]
        for k, joint in enumerate(joints):
            end = self.add(end, joint, driven=k == 0)
        there, c = other.rotation.T @ (tip - other.origin), "drake:ball_constraint"
        self.parts.append(
            f'<{c}><{c}_body_A name="{end.link}"/><{c}_body_B name="{other.link}"/>'
            f'<{c}_p_AP value="{_text(local)}"/><{c}_p_BQ value="{_text(there)}"/></{c}>'
        )


def _text(values: np.ndarray) -> str:
    return " ".join(f"{x:.15g}" for x in values)


def write_machine(seed: int, most: int = MAX_JOINTS) -> str:
    """Return a random machine of up to so many joints as URDF text."""
    rng = np.random.default_rng(seed)
    made, wanted = _Writer(rng), int(rng.integers(1, most + 1))
    while made.n < wanted:
        place = made.places[int(rng.integers(len(made.places)))]
        if wanted - made.n > _FREE and rng.random() < 0.7:
            made.add_loop(place if rng.random() < 0.5 else made.places[0])
        else:
            for _ in range(int(rng.integers(1, min(3, wanted - made.n) + 1))):
                place = made.add(place, made.draw(("revolute", "prismatic")), driven=True)
    return f'<robot name="machine" xmlns:drake="http://drake.mit.edu">{"".join(made.parts)}</robot>'


def build_machine(seed: int, most: int = MAX_JOINTS) -> tuple[Robot, Model]:
    """Return a random machine and its model with friction of its own in every drive."""
    rng, robot = np.random.default_rng([seed, 1]), load_robot_from_urdf(write_machine(seed, most), f"machine{seed}")
    model = build_model(robot, "asymmetric")
    names = model.effect_parameters.names
    return robot, model.with_values(dict(zip(names, rng.uniform(1, 5, len(names)), strict=True)))


def record(model: Model, seed: int, seconds: float = 8.0, name: str = "own.csv") -> Log:
    """Return what a model records along a random motion: positions and its own forces, without noise."""
    path = build_named_motion("fourier", model, seconds, seed).every(5)
    tau, channels = model.torque(path.q, path.v, path.a), {}
    for k, joint in enumerate(model.robot.actuated):
        channels |= {f"q_{joint}": path.q[:, k], f"v_{joint}": path.v[:, k], f"tau_{joint}": tau[:, k]}
        channels |= {f"q_ref_{joint}": path.q[:, k], f"temp_{joint}": 20 + 0.1 * path.t}
    return Log(path.t, channels, name)


def write_some(log: Log, path: Path, draw: Random) -> None:
    """Write a log with a random part of its channels and of its samples; positions and forces are kept more often."""
    keep = [
        c for c in log.channels if draw.random() < (0.97 if c.startswith(("q_", "tau_")) and "ref" not in c else 0.5)
    ]
    start, stop = (0, log.n_samples) if draw.random() < 0.7 else sorted(draw.sample(range(log.n_samples), 2))
    draw.shuffle(keep)
    Log(log.t[start:stop], {c: log.channels[c][start:stop] for c in keep}, log.name).to_csv(path)
