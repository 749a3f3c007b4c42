"""How many poses a model needs at least: its rank over the joints' range by the numbers that one pose gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.calibrate.frames import IDENTITY, DeviceFrames
from tau_dyn.calibrate.geometry import Geometry
from tau_dyn.calibrate.identifiability import find_identifiable
from tau_dyn.calibrate.pose_set import PoseSet
from tau_dyn.calibrate.residuals import Problem
from tau_dyn.calibrate.start import count_required_poses
from tau_dyn.calibrate.unknowns import Unknowns
from tau_dyn.exceptions import InputError


def check_count(poses: PoseSet, geometry: Geometry, unknowns: Unknowns, problem: Problem, what: str) -> None:
    """Refuse fewer measurements than unknowns.

    Raises:
        InputError: Too few poses; says how many are needed.
    """
    m = sum(problem.blocks)
    free = int(unknowns.free.sum())
    if poses.n >= count_required_poses(free, m):
        return
    rank = compute_structural_rank(poses, geometry, unknowns, problem)
    needed = count_required_poses(rank, m)
    if poses.n >= needed:
        return
    have = "1 pose is" if poses.n == 1 else f"{poses.n} poses are"
    raise InputError(
        "too_little_data",
        f"{poses.source}: {have} too few for {what}, which has {rank} unknowns that poses can tell, at {m} numbers a pose; "
        f"at least {needed} are needed, {3 * needed} are sensible",
    )


def compute_structural_rank(poses: PoseSet, geometry: Geometry, unknowns: Unknowns, problem: Problem) -> int:
    """Return the rank that random poses within the range of these (widened where they do not move) would give."""
    rng = np.random.default_rng(0)
    low, high = poses.q.min(axis=0), poses.q.max(axis=0)
    width = np.maximum(high - low, 0.1)
    q = 0.5 * (low + high) + width * (rng.random((4 * int(unknowns.free.sum()), poses.na)) - 0.5)
    found = geometry.forward(geometry.parameters.values, q)
    q = q[found.ok]
    rotation = None if poses.rotation is None else np.repeat(np.eye(3)[None], len(q), axis=0)
    number, several = np.arange(len(q)), tuple(poses.targets)
    many = PoseSet(
        q,
        np.zeros((len(q), 3)),
        rotation,
        campaign=number % len(poses.campaigns),
        target=number % len(several),
        targets=several,
        approach=np.sign(rng.standard_normal(q.shape)),
    )
    wide = replace(problem, poses=many)
    frames = _one_of_each(unknowns)
    state = wide.place(geometry.parameters.values, frames, np.zeros(poses.na), None)
    seen = state.frames.measured(state.base, many.setup)
    wide = replace(
        wide, poses=replace(many, position=seen.position, rotation=None if rotation is None else seen.rotation)
    )
    columns = wide.columns(state)[:, :, unknowns.free]
    names = tuple(np.array(unknowns.names)[unknowns.free])
    flat = columns.reshape(-1, columns.shape[2])
    return find_identifiable(flat, names, unknowns.scales[unknowns.free], unknowns.priority[unknowns.free]).rank


def _one_of_each(unknowns: Unknowns) -> DeviceFrames:
    return DeviceFrames((IDENTITY,) * (unknowns.n_device // 6), (IDENTITY,) * (unknowns.n_tool // 6))
