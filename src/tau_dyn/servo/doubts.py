"""Warnings about an identification through the closed loop, as sentences with codes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import minimum_filter1d

from tau_dyn.log import Log
from tau_dyn.message_codes import CodedWarning
from tau_dyn.servo.records import LoopRecord
from tau_dyn.simulate import ServoLaw

if TYPE_CHECKING:
    from tau_dyn.servo.data import LoopData
    from tau_dyn.servo.fit import LoopFit

BEYOND = 1.3
"""Acceleration of held-out logs over that of all training logs from which a prediction extrapolates."""
SUSTAINED = 90.0
"""Percentile of a log's acceleration that is compared: single steps are not representative."""
MIN_DROOP_RAD = 0.03
"""Least lost motion at rest that is explained as droop [rad]: above the play of hobby servos."""
REST_S = 0.15
"""Shortest rest [s]: a chirp reverses faster."""
MIN_BODY_FACTOR = 1.5
"""Factor of all bodies, or its inverse, from which the given gain is doubted: twice the quarter to which a file's are trusted."""
MAX_LEFT_BY_FACTOR = 0.1
"""Share of the loads' squares that one factor may leave; more is another body, not another scale."""
LOAD_SAMPLES_S = 0.05  # time between the samples on which loads are compared
_LOADS = ("load", "current", "effort")
MAX_UNSIGNED = 32767  # beyond it a register holds negative numbers as two's complements
_MIN_LIKENESS = 0.4  # correlation with the position error from which a channel is its magnitude


def list_loop_warnings(
    law: ServoLaw,
    train: Sequence[LoopRecord],
    held: Sequence[LoopRecord],
    logs: Sequence[Log],
    data: LoopData,
    fit: LoopFit,
) -> list[str]:
    """Return all warnings."""
    return [
        *_describe_scale(law, data),
        *_describe_scaled_bodies(law, data, fit),
        *_describe_accelerations(law.joints, train, held),
        *_describe_droop(law.joints, train),
        *_describe_unsigned_loads(law.joints, logs),
        *_describe_bounds(data, fit),
    ]


def list_unsettled(logs: Sequence[tuple[str, float | None]]) -> list[str]:
    """Return a sentence for each log, by name, whose simulation did not converge from a time [s] on."""
    return [
        CodedWarning(
            "not_settled",
            f"{name}: from {since:.1f} s the simulated joints push each other and do not settle; results of this log from "
            "there on cannot be trusted",
        )
        for name, since in logs
        if since is not None
    ]


def _describe_scale(law: ServoLaw, data: LoopData) -> list[str]:
    if law.given and not {"position_gain", "force_per_unit"} & law.estimated:
        return []
    fixed = [p.name for p in data.model.robot.parameters if p.name.endswith(".mass") and (not p.free or p.prior_stderr)]
    if fixed:
        return [
            f"the servo's gain is estimated; the scale of all masses and friction comes from {', '.join(fixed[:3])}"
        ]
    return [
        CodedWarning(
            "gain_unknown",
            "the servo's gain is not known, so masses and friction are known up to its scale, which the robot file's masses set "
            "here; a weighed mass (--fix LINK.mass=VALUE) or a known gain (--controller LAW.yaml) fixes it",
        )
    ]


def _describe_scaled_bodies(law: ServoLaw, data: LoopData, fit: LoopFit) -> list[str]:
    """Return a warning if all bodies' loads are those of the robot file times one factor: a given gain scales them likewise."""
    if not law.given or {"position_gain", "force_per_unit"} & law.estimated:
        return []
    space, u = data.space, data.unknowns
    theta = space.at(fit.x[u.n - space.n_unknowns :])
    loads = []
    for r in data.records:
        some = np.flatnonzero(r.used & (r.enabled > 0))[:: max(1, int(LOAD_SAMPLES_S / r.interval))]
        if len(some):
            loads.append(
                space.model.mechanism.regressor(*(x[some] for x in r.motion)) @ np.stack([space.nominal, theta], axis=1)
            )
    nominal, found = np.concatenate([rows.reshape(-1, 2) for rows in loads]).T
    factor = float(nominal @ found / max(nominal @ nominal, 1e-300))
    left = float(np.sum((found - factor * nominal) ** 2) / max(found @ found, 1e-300))
    if left > MAX_LEFT_BY_FACTOR or factor <= 0 or abs(np.log(factor)) < np.log(MIN_BODY_FACTOR):
        return []
    return [
        CodedWarning(
            "gain_unknown",
            f"all bodies come out {factor:.2g} times those of the robot file: where the file's masses are right, the law's gain "
            f"(position_gain times force_per_unit) is {factor:.2g} times the servo's, and friction is off alike; weigh a body "
            "(--fix LINK.mass=VALUE) and estimate the gain",
        )
    ]


def _describe_accelerations(
    joints: Sequence[str], train: Sequence[LoopRecord], held: Sequence[LoopRecord]
) -> list[str]:
    if not held:
        return []
    known = np.max([np.percentile(np.abs(r.motion[2]), SUSTAINED, axis=0) for r in train], axis=0)
    said = []
    for r in held:
        here = np.percentile(np.abs(r.motion[2]), SUSTAINED, axis=0)
        worst = int(np.argmax(here / np.maximum(known, 1e-3)))
        if here[worst] > BEYOND * known[worst] and here[worst] > 0.5:
            said.append(
                CodedWarning(
                    "outside_training",
                    f"{r.name}: {joints[worst]} accelerates with {here[worst]:.2g} rad/s^2 over a tenth of the time, "
                    f"the training logs with {known[worst]:.2g}; the prediction leaves the learnt range",
                )
            )
    return said


def _describe_droop(joints: Sequence[str], records: Sequence[LoopRecord]) -> list[str]:
    said = []
    for j, joint in enumerate(joints if records[0].told == "position" else ()):
        still = [r.used & _find_rest(r.motion[1][:, j], r.dt) for r in records]
        gaps = np.concatenate([(r.q - r.command)[s, j] for r, s in zip(records, still, strict=True)])
        if len(gaps) > 20 and (most := float(np.percentile(np.abs(gaps), 99))) > MIN_DROOP_RAD:
            said.append(f"{joint} {1e3 * most:.0f} mrad")
    if not said:
        return []
    return [
        CodedWarning(
            "droop",
            f"at rest the joints stay behind their commands ({', '.join(said)}): a proportional servo yields to gravity and "
            "friction; this lost motion is droop, no backlash",
        )
    ]


def _find_rest(v: np.ndarray, dt: float) -> np.ndarray:
    """Return the mask (N,) of samples at which a joint rests, without reversals."""
    return minimum_filter1d((np.abs(v) < 0.02).astype(np.uint8), max(1, round(REST_S / dt))) > 0


def _describe_unsigned_loads(joints: Sequence[str], logs: Sequence[Log]) -> list[str]:
    found: dict[str, list[float]] = {}
    for log in logs:
        sizes = np.abs(log.joint("cmd", joints) - log.joint("q", joints))
        for name, x in log.channels.items():
            if (
                not name.lower().startswith(_LOADS)
                or not np.isfinite(x).all()
                or x.min() < 0
                or np.ptp(x) == 0
                or x.max() > MAX_UNSIGNED
            ):
                continue
            likeness = [float(np.corrcoef(size, x)[0, 1]) for size in sizes.T if np.ptp(size) > 0]
            found.setdefault(name, []).append(max(likeness, default=0.0))
    like = {name: max(rows) for name, rows in found.items() if max(rows) > _MIN_LIKENESS}
    if not like:
        return []
    low, high = min(like.values()), max(like.values())
    return [
        CodedWarning(
            "unsigned_load",
            f"{', '.join(list(like)[:3])}{' and others' if len(like) > 3 else ''} follow the size of the position error "
            f"(correlation {low:.2f} to {high:.2f}) and have no sign: a check of the law, but no torque, and not used as one",
        )
    ]


def _describe_bounds(data: LoopData, fit: LoopFit) -> list[str]:
    u = data.unknowns
    values = u.with_values(fit.x)
    at = [
        f"{joint}.{kind}"
        for k, kind in enumerate(u.kinds)
        for j, joint in enumerate(data.law.joints)
        if u.free[k, j] and kind in ("armature", "coulomb") and values[kind][j] <= u.lower[k, j]
    ]
    return (
        [f"{', '.join(at)} ended at the lower bound; the logs do not show it next to the rest of the law"] if at else []
    )
