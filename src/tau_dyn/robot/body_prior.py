r"""Prior knowledge of a robot's bodies before any log; the whole program uses this one prior.

An inertial number `x` has the value `x0` of the robot file. Its error is the stated one (`--fix LINK.mass=VALUE+-SIGMA`, the
model of a fleet). If no error is stated, the file is one of two kinds, and it is unknown which one before the logs are used:

    accurate     x ~ N(x0, (0.02 s)^2)      s = m r^k,  k = 0 mass, 1 first moment, 2 inertia
    rough        x ~ N(x0, (0.25 s)^2)      m mass of the body, r its radius of gyration about the joint frame's origin

This is a contaminated normal distribution (Tukey 1960; Box & Tiao 1968). It answers two questions:

- *Is the file right about this body?* The null hypothesis is the accurate file. A difference beyond `accurate` is reported. A
  single cause of it has to be likelier than the rough file, in which every body is wrong as a whole.
- *How large may the error of a body be in directions without information in the logs?* No log excludes the rough file there, so
  `rough` is the spread.

A body that the file repeats as a sphere on its joint may be a placeholder (`find_placeholders`): if the file is rough, its
numbers are uncertain by their own size.

One number cannot answer both. At 25 %, a link that is too heavy by half is not reported. At 2 %, a quantity that only the file
determines (a compliance, the size of a body) has an interval that is ten times too narrow for a manufacturer's file.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot.robot import INERTIAL, LinkInertia, Robot

ACCURATE_FILE = 0.02
"""Standard deviation of a number of an accurate file, relative to the body's size.

It is the accuracy of a CAD volume with a catalogue density, and the level from which a difference is worth reporting."""
ROUGH_FILE = 0.25
"""Standard deviation of a number of a rough file, relative to the body's size.

The masses in the files of the UR5 and the UR10 sum to 20.99 and 32.70 kg; the manufacturer states 18.4 and 28.9 kg. Independent
errors `e` of the links, `sum m = M`, give a total error of `e sqrt(sum m^2)`: so `e` is 28 and 26 % of a link."""
PLACEHOLDER = 1.0
"""Standard deviation of a placeholder's number in a rough file, relative to the body's size."""
MIN_PLACEHOLDERS = 3
"""Number of links with the same mass and the same round inertia from which these are placeholders."""
_CENTRED_M = 1e-6
"""Largest distance of a placeholder's centre from its frame's origin, for rounding [m]."""
MIN_MASS_SHARE = 1e-3
"""Assumed mass of a body without mass, relative to that of all bodies."""
UNKNOWN_RADIUS_M = 0.05
"""Assumed radius of a body whose centre and inertia are not given: that of a hand-sized part."""
LENGTH_POWERS = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])
"""Powers of a length in the ten inertial numbers."""


@dataclass(frozen=True)
class BodyPrior:
    """Sizes and standard deviations of a robot's inertial numbers before any log, by parameter name [the parameter's unit].

    Attributes:
        size: Size of the number for its body, `m r^k`.
        accurate: Standard deviation if the file is accurate, or the stated one; drive inertias are included.
        rough: Standard deviation if the file may be rough, or the stated one.
    """

    size: dict[str, float]
    accurate: dict[str, float]
    rough: dict[str, float]

    @classmethod
    def of(cls, robot: Robot, parameters: Parameters | None = None) -> BodyPrior:
        """Return the prior of a robot; if its file has no mass, the prior of the drives alone.

        The stated error of a mass does not change the prior of the body's centre and inertia, unless it is larger than the
        default; then they are known no better than the mass.

        Args:
            robot: The robot.
            parameters: Parameters that state errors (`prior_stderr`); by default the robot's own.
        """
        given = robot.parameters if parameters is None else parameters
        stated = {p.name: p.prior_stderr for p in given if p.prior_stderr is not None}
        total = sum(max(float(link.nominal[0]), 0.0) for link in robot.links)
        placeholders = find_placeholders(robot.model)
        size: dict[str, float] = {}
        accurate, rough = ({p.name: ACCURATE_FILE * abs(p.value) for p in given if p.name.endswith(".armature")}, {})
        for link in robot.links if total > 0 else ():
            sizes = compute_body_size(link, total)
            weighed = stated.get(f"{link.link}.{INERTIAL[0]}", 0.0) / sizes[0]
            for k, name in zip(link.own, link.names, strict=True):
                size[name] = float(sizes[k])
                accurate[name] = max(ACCURATE_FILE, weighed) * size[name]
                rough[name] = max(PLACEHOLDER if link.joint_id in placeholders else ROUGH_FILE, weighed) * size[name]
        accurate |= {name: stderr for name, stderr in stated.items() if name in accurate}
        rough |= {name: stderr for name, stderr in stated.items() if name in rough}
        return cls(size, accurate, rough)


def find_placeholders(model: pin.Model) -> frozenset[int]:
    """Return the joints whose bodies are spheres about their frames' origins, with the same mass and inertia as two others.

    Simulators require inertias, so files contain one invented value for all links. No three parts of a robot are equal spheres
    with their centres on the joints; equal arms with a centre between their ends are no placeholders.

    Args:
        model: The tree. The body of a joint holds the links that are fixed to it, whose frames keep their own inertia.
    """
    links = [(f.parentJoint, f.placement, f.inertia) for f in model.frames if f.inertia.mass > 0]
    first = list(model.inertias)
    for joint, placement, inertia in links:
        first[joint] = first[joint] - placement.act(inertia)
    bodies = [(joint, _round_body(inertia)) for joint, _, inertia in links]
    bodies += [
        (joint, _round_body(own)) for joint, own in enumerate(first) if own.mass > 1e-9 * model.inertias[joint].mass
    ]
    number = Counter(body for _, body in bodies)
    real = {joint for joint, body in bodies if body is None or number[body] < MIN_PLACEHOLDERS}
    return frozenset({joint for joint, _ in bodies} - real - {0})


def _round_body(body: pin.Inertia) -> tuple[str, str] | None:
    """Return mass and inertia, to six digits, of a sphere about its frame's origin; None for any other body."""
    moment = float(np.trace(body.inertia)) / 3
    if (
        not moment > 0
        or np.linalg.norm(body.lever) > _CENTRED_M
        or not np.allclose(body.inertia, moment * np.eye(3), rtol=0, atol=1e-6 * moment)
    ):
        return None
    return f"{body.mass:.6g}", f"{moment:.6g}"


def compute_nominal_stderr(p: Parameter) -> float | None:
    """Return the standard deviation of a nominal value: the stated one, or that of a mass in an accurate file, or None."""
    if p.prior_stderr is not None:
        return p.prior_stderr
    return ACCURATE_FILE * abs(p.value) if p.name.endswith(".mass") else None


def compute_body_radius(link: LinkInertia, total: float) -> float:
    """Return a body's radius of gyration about its joint frame's origin [m], or the distance of its centre if that is larger.

    Args:
        link: The body.
        total: Mass of all bodies [kg].
    """
    mass = max(float(link.nominal[0]), MIN_MASS_SHARE * total)
    trace = float(link.nominal[[4, 6, 9]].sum())
    gyration = np.sqrt(trace / mass / 2) if trace > 0 else UNKNOWN_RADIUS_M
    return max(float(gyration), float(np.linalg.norm(link.nominal[1:4])) / mass, 1e-3)


def compute_body_size(link: LinkInertia, total: float) -> np.ndarray:
    """Return the sizes `m r^k` of a body's ten inertial numbers (10,) [kg, kg m, kg m^2]; see `compute_body_radius`."""
    mass = max(float(link.nominal[0]), MIN_MASS_SHARE * total)
    return mass * compute_body_radius(link, total) ** LENGTH_POWERS
