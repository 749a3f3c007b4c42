"""A UR5 whose forces Pinocchio computes, with symmetric friction, rotors and 1 % of noise: nothing is hidden, all is known."""

from collections.abc import Iterator

import numpy as np
from spoiled_logs_parts.machines import as_log, make_log

from comparison_parts.case import Case, split_in_time

SEEDS = (71, 72, 73)


def read() -> Iterator[Case]:
    for seed in SEEDS:
        made, rng = make_log("ur5", seed, noise=0.0), np.random.default_rng([30, seed])
        _, v, a = made.motion
        joints, known = made.robot.actuated, {}
        force = made.bodies + a * [made.truth[f"{j}.armature"] for j in joints]
        for k, joint in enumerate(joints):
            coulomb, viscous = (made.truth[f"{joint}.{key}_pos"] for key in ("coulomb", "viscous"))
            force[:, k] += coulomb * np.sign(v[:, k]) + viscous * v[:, k]
            known |= {f"{joint}.coulomb": (coulomb, 0.0), f"{joint}.viscous": (viscous, 0.0)}
        force += 0.01 * np.sqrt(np.mean(force**2, axis=0)) * rng.normal(size=force.shape)
        train, held = split_in_time(as_log(made.robot, made.log.t, made.position, force, f"ur5_{seed}"))
        yield Case(
            f"simulated UR5 {seed}", "force", train, held, made.robot, known=known, simulated=True,
            refuted={"*": "nothing is hidden"}, published="", origin="this page",
        )  # fmt: skip
