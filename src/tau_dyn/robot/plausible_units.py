"""Warnings about units of a robot file, from sizes and densities that no robot has."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

MAX_LENGTH_M = 100.0
"""Largest distance between neighbouring joints, or of a centre of mass from its joint; the boom of a crane is shorter."""
MAX_LIMIT_RAD = 25.0
"""Largest limit of a turning joint, four turns; +-30 degrees written as such exceed it."""
MIN_DENSITY_KG_M3 = 0.01
"""Smallest mass over the cube of the radius of gyration, a hundredth of the density of air. A slender rod of 1 kg and 3 m
has 1.5; an inertia in kg mm^2 or a file in mm lowers it by 1e9, one in kg cm^2 by 1e6, one in mm and g by 1e6."""
MIN_MASS_SHARE = 0.01
"""Share of the robot's mass from which a body counts; dummy links have tiny masses and any inertia."""


def list_unit_warnings(model: pin.Model, where: str) -> list[str]:
    """Return sentences about lengths and inertias that look like those of another unit.

    Args:
        model: The tree, with links that are fixed to each other merged.
        where: Beginning of the sentences.
    """
    names, bodies = list(model.names), list(model.inertias)
    found = []
    apart = [float(np.linalg.norm(placement.translation)) for placement in model.jointPlacements]
    centres = [float(np.linalg.norm(body.lever)) if body.mass else 0.0 for body in bodies]
    k = int(np.argmax(np.maximum(apart, centres)))
    length = max(apart[k], centres[k])
    if length > MAX_LENGTH_M:
        what = (
            f"lies {length:.3g} m from the joint before" if apart[k] == length else f"has a centre {length:.3g} m away"
        )
        found.append(f"joint '{names[k]}' {what}; are lengths in mm? They are read in m")
    joints = ((k, model.joints[k]) for k in range(1, model.njoints))
    turning = [k for k, joint in joints if joint.nq == 1 and joint.shortname().startswith("JointModelR")]
    bounds = {
        names[k]: [float(x[model.joints[k].idx_q]) for x in (model.lowerPositionLimit, model.upperPositionLimit)]
        for k in turning
    }
    wide = [name for name, ends in bounds.items() if MAX_LIMIT_RAD < max(map(abs, ends)) <= 360]
    if wide:
        low, high = bounds[wide[0]]
        found.append(
            f"the limits of {', '.join(wide)} reach {low:.4g} to {high:.4g} rad; are they in degrees? They are read in rad"
        )
    heavy = MIN_MASS_SHARE * sum(body.mass for body in bodies)
    for name, body in zip(names, bodies, strict=True):
        radius = float(np.sqrt(np.trace(body.inertia) / 2 / body.mass)) if body.mass > 0 else 0.0
        if body.mass >= heavy and body.mass < MIN_DENSITY_KG_M3 * radius**3:
            found.append(
                f"the body of joint '{name}' has {body.mass:.3g} kg and a radius of gyration of {radius:.3g} m, lighter "
                "than any robot; is its inertia in another unit, such as kg mm^2? It is read in kg m^2"
            )
    return [f"{where}: {sentence}" for sentence in found]
