"""A `Regression` from a model and torque logs: differentiate, evaluate every column, filter both sides equally, mask.

The order matters. Positions are low-passed only enough to be differentiated, and forces equally; the columns, signs
included, are evaluated at the full rate. A gate `g` then takes out the samples at which a sign is not known (reversals,
speeds within the noise) or that the user excludes, *before* the low-pass `F` that both sides share:

    y = F(g tau) / F(g),   W = F(g Y) / F(g)

so that `y = W theta` stays exact and a reversal does not leak into its neighbourhood (normalised convolution,
Knutsson & Westin 1993). Samples at which less than half of the filter's weight is left are masked; the rest are decimated. The
gate is chosen in `preparation.py`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np

from tau_dyn.effects import (
    REPORTED,
    Effect,
    JointMotion,
    JointwiseEffect,
    Motion,
    get_measured_signals,
    name_effect_in_errors,
)
from tau_dyn.estimate import ROUNDING, Preparation, Regression, RegressionRun
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.identify.motor_electrics import RECORDED, SPEED
from tau_dyn.identify.preparation import (
    NOISE_FACTOR,
    Kept,
    choose_preparation,
    compute_base_cutoff,
    compute_contact_gate,
    compute_expected_direction,
    compute_gate,
    find_excluded_samples,
    hold_closed,
    keep_long,
    refuse_jumps,
    refuse_missing_campaign,
    refuse_missing_temperature,
    refuse_short,
    select_long,
)
from tau_dyn.legged import ContactElimination
from tau_dyn.log import (
    MIN_SEGMENT_SAMPLES,
    Log,
    compute_edge_samples,
    decimate,
    differentiate,
    lowpass,
    lowpass_and_decimate,
    resample_segments,
)
from tau_dyn.model import Model

MIN_SHARE = 0.5
"""Share of the filter's weight that must be on usable samples."""
MIN_FLIGHT_SHARE = 0.15
"""The same for a joint of a leg in the air: flights are shorter than the filter's memory, and most would be lost."""
MIN_FLIGHT_SAMPLES = 30
"""Usable samples of a joint of a leg from which they count; the noise of a few, fitted exactly, would seem to be zero."""
_MAX_VALUES = 2_000_000  # filtered in one call: 16 MB


def build_regression(
    model: Model,
    logs: Log | Iterable[Log],
    *,
    preparation: Preparation | None = None,
    exclude: tuple[str, ...] = (),
    at: Model | None = None,
    campaigns: Sequence[str] = (),
) -> Regression:
    """Build the regression of a model on torque logs.

    Args:
        model: Model that gives the columns: its robot's parameters, then its effects'.
        logs: Logs with `q_J` and `tau_J` for every actuated joint; never joined across their ends.
        preparation: Filters and masks; by default chosen from the logs themselves.
        exclude: Columns whose nonzero samples are left out, if no preparation is given.
        at: The same model at the values from which signals such as forces and loads are computed; by default `model`'s own.
        campaigns: Names of logs that are numbered before these, for effects that distinguish recordings.

    Raises:
        InputError: A log lacks a column that the robot or an effect needs, or the robot cannot reach a logged position.
        CannotAnswer: No piece is long enough for the filters, or the masks leave no sample.

    Example:
        >>> t, w = np.arange(0.0, 10.0, 0.005), np.array([[3.0], [7.0]])
        >>> q, v, a = (np.sum(x, axis=0) for x in (0.1 * np.sin(w * t), 0.1 * w * np.cos(w * t), -0.1 * w**2 * np.sin(w * t)))

        >>> log = td.Log(t, {"q_axis": q, "tau_axis": 90.0 * a})
        >>> regression = td.build_regression(td.Model.of(td.load_robot("linear_axis")), log)
        >>> W, y, _ = regression.stacked()
        >>> bool(np.abs(y - 90.0 * W[:, 0]).max() < 0.01 * np.abs(y).max())
        True
    """
    logs = [logs] if isinstance(logs, Log) else list(logs)
    if not logs:
        raise InputError("missing_input", "no log was given")
    for log in logs:
        refuse_jumps(log, model.robot, exclude)
    pieces = [piece for log in logs for piece in resample_segments(log)]
    if not pieces:
        raise refuse_short(logs, MIN_SEGMENT_SAMPLES / logs[0].rate_hz)
    return build_regression_of_pieces(
        model, pieces, preparation=preparation, exclude=exclude, at=at, campaigns=campaigns
    )[0]


def build_regression_of_pieces(
    model: Model,
    pieces: Sequence[Log],
    *,
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    at: Model | None,
    campaigns: Sequence[str],
) -> tuple[Regression, Kept]:
    """Build the regression on even stretches, and return which of them are long enough; see `build_regression`."""
    if not pieces:
        raise InputError("missing_input", "no log was given")
    preparation = preparation or choose_preparation(model.robot, select_long(pieces), exclude)
    kept = keep_long(pieces, preparation.force_cutoff_hz, preparation.factor)
    pieces = kept.of(pieces)
    names = list(dict.fromkeys([*campaigns, *(piece.name for piece in pieces)]))
    if not campaigns:
        refuse_missing_campaign(model, names)
    runs = []
    for piece in pieces:
        number = {"campaign": np.full(piece.n_samples, float(names.index(piece.name)))}
        runs.append(prepare_segment(at or model, piece, preparation, signals=number).run(model))
    robot = model.robot
    runs = runs if campaigns else leave_out_rare_joints(runs, len(robot.base_coordinates))
    regression = Regression(model.parameters, robot.actuated, robot.force_units, tuple(runs), preparation)
    if regression.n_samples == 0:
        raise _nothing_left(model, pieces, preparation)
    return regression, kept


def leave_out_rare_joints(
    runs: list[RegressionRun], n_base: int, least: int = MIN_FLIGHT_SAMPLES
) -> list[RegressionRun]:
    """Return the runs of a floating base without joints of legs with fewer usable samples in the air; others as they are."""
    if not n_base:
        return runs
    often = np.sum([run.usable.sum(axis=0) for run in runs], axis=0) >= least
    often[:n_base] = True
    return [replace(run, usable=run.usable & often) for run in runs]


@dataclass(frozen=True, eq=False)
class PreparedSegment:
    """One even stretch of a log, differentiated and gated, from which any effect's columns can be computed.

    Attributes:
        log: The stretch.
        motion: Its motion at the log's rate, with the requested signals.
        force: Forces (N, na) [N or N m].
        gate: 1 for a sample that counts, 0 for others (N, na).
        preparation: Filters and masks.
        usable: Which decimated samples a fit may use (n, na).
        weight: Share of the filter's weight on usable samples (n, na); 1 for samples that are not usable.
        rate_hz: Rate of the log [Hz].
        contacts: Elimination of the ground's forces from a floating base's equations, before the filter; None without.
    """

    log: Log
    motion: Motion
    force: np.ndarray
    gate: np.ndarray
    preparation: Preparation
    usable: np.ndarray
    weight: np.ndarray
    rate_hz: float
    contacts: ContactElimination | None = None

    @property
    def factor(self) -> int:
        """Decimation."""
        return self.preparation.factor(self.rate_hz)

    def close_after(self, late: np.ndarray) -> PreparedSegment:
        """Return the segment with every closed stretch of the gate held closed for longer.

        A reversal appears later by `late` in a force that is logged late, and its step would leak into the samples that follow.

        Args:
            late: Delay of each joint's force (na,) [s]; if negative (logged early), closed stretches begin sooner by it.
        """
        samples = np.round(late * self.rate_hz).astype(int)
        gate = np.column_stack([hold_closed(x, int(n)) for x, n in zip(self.gate.T, samples, strict=True)])
        share = self.passed(gate)
        usable = self.usable & (share > MIN_SHARE)
        return replace(self, gate=gate, usable=usable, weight=np.where(usable, share, 1.0))

    def passed(self, x: np.ndarray) -> np.ndarray:
        """Return an array (N, ...) through the low-pass that both sides share, decimated (n, ...)."""
        return lowpass_and_decimate(x, self.preparation.force_cutoff_hz, self.rate_hz, self.factor)

    def without_contacts(self, rows: np.ndarray) -> np.ndarray:
        """Return forces (N, na) or columns (N, na, p) without the forces of the ground; see `legged/contacts.py`."""
        return rows if self.contacts is None else self.contacts.project(rows)

    def columns(self, Y: np.ndarray, *, gated: bool = True) -> np.ndarray:
        """Return columns (N, na, p) after filter and decimation (n, na, p), joint by joint; many are zero for a joint.

        Samples are last in memory, for fast filters.
        """
        return self.filter_columns(self.without_contacts(Y), gated=gated)

    def filter_columns(self, Y: np.ndarray, *, gated: bool, equations: np.ndarray | None = None) -> np.ndarray:
        """Return columns (N, na, p) without forces of the ground after filter and decimation (n, na, p); see `columns`.

        Only some equations (na,) are filtered if they are given; others are zero.
        """
        N, na, p = Y.shape
        rows = np.ascontiguousarray(Y.transpose(1, 2, 0))
        is_felt = (rows.max(axis=2, initial=0) != 0) | (rows.min(axis=2, initial=0) != 0)
        k, column = np.nonzero(is_felt if equations is None else is_felt & equations[:, None])
        out = np.zeros((na, p, -(-N // self.factor)))
        if k.size:
            touching = rows[k, column]
            if gated:
                touching *= np.ascontiguousarray(self.gate.T)[k]
            out[k, column] = self.passed(touching.T).T
        if gated:
            out /= self.weight.T[:, None]
        return out.transpose(2, 0, 1)

    def columns_of(self, effects: Sequence[Effect]) -> list[np.ndarray]:
        """Return the gated columns (n, na, p) of several effects, filtered together; zeros are not filtered."""
        gate, N = np.ascontiguousarray(self.gate.T), len(self.gate)
        out, rows, places = [], [], []

        def finish() -> None:
            if rows:
                for (made, k, column), x in zip(places, self.passed(np.stack(rows).T).T, strict=True):
                    made[k, column] += x / self.weight[:, k]
            rows.clear()
            places.clear()

        for effect in effects:
            if self.contacts is not None and not _acts_by_joint(effect):
                out.append(self.columns(effect.columns(self.motion)).transpose(1, 2, 0))
                continue
            size, touching = _list_touching(effect, self.motion)
            out.append(np.zeros((gate.shape[0], size, -(-N // self.factor))))
            for joint, column, x in touching:
                for k, share in self._list_equations(joint):
                    rows.append(gate[k] * share * x)
                    places.append((out[-1], k, column))
                if len(rows) * N > _MAX_VALUES:
                    finish()
        finish()
        return [made.transpose(2, 0, 1) for made in out]

    def _list_equations(self, joint: int) -> Iterator[tuple[int, np.ndarray | float]]:
        """Return the equations in which a joint's force is, with its factor (N,): its own alone without contacts."""
        if self.contacts is None:
            yield joint, 1.0
            return
        shares = self.contacts.G[:, joint].T
        yield from ((k, share) for k, share in enumerate(shares) if share.any())

    def run(self, model: Model) -> RegressionRun:
        """Return the regression of a model on this stretch."""
        Y, force = self.without_contacts(compute_columns(model, self.motion)), self.without_contacts(self.force)
        y = self.passed(self.gate * force) / self.weight
        signals = {key: decimate(getattr(self.motion, key), self.factor) for key in ("q", "v", "a")}
        joints = model.robot.actuated
        for name in RECORDED:
            if self.log.has(name, joints):  # through both filters, as forces are
                smooth = lowpass(self.log.joint(name, joints), self.preparation.position_cutoff_hz, self.rate_hz)
                signals |= {name: self.passed(smooth), SPEED: self.passed(self.motion.v)}
        W_all = self.filter_columns(Y, gated=False)
        if self.contacts is None:
            W = self.filter_columns(Y, gated=True)
        else:  # the base's equations are mostly never shut
            shut = np.abs(self.gate - 1).max(axis=0) > ROUNDING
            W = np.where(shut[:, None], self.filter_columns(Y, gated=True, equations=shut), W_all)
        return RegressionRun(
            self.log.name,
            decimate(self.log.t, self.factor),
            W,
            y,
            self.usable,
            W_all,
            self.passed(force),
            signals,
        )


def compute_columns(model: Model, motion: Motion) -> np.ndarray:
    """Return all columns (N, na, p) along a motion, samples last in memory; see `Model.columns`."""
    rigid = model.mechanism.regressor(motion.q, motion.v, motion.a)
    N, na, first = rigid.shape
    out = np.zeros((na, len(model.parameters), N))
    out[:, :first] = rigid.transpose(1, 2, 0)
    for effect in model.effects:
        last = first + len(effect.parameters)
        with name_effect_in_errors(effect):
            _fill(out[:, first:last], effect, motion)
        first = last
    return out.transpose(2, 0, 1)


def _fill(out: np.ndarray, effect: Effect, motion: Motion) -> None:
    """Write an effect's columns (na, p, N); those of each joint alone without the zeros between them."""
    if not _acts_by_joint(effect):
        out[:] = effect.columns(motion).transpose(1, 2, 0)
        return
    for k, column, x in _list_touching(effect, motion)[1]:
        out[k, column] = x


def _acts_by_joint(effect: Effect) -> TypeGuard[JointwiseEffect]:
    return isinstance(effect, JointwiseEffect) and type(effect).columns is JointwiseEffect.columns


def _list_touching(effect: Effect, motion: Motion) -> tuple[int, Iterator[tuple[int, int, np.ndarray]]]:
    """Return how many columns an effect has, and joint, column and values (N,) of those that are not zero."""
    if _acts_by_joint(effect):
        n, every = len(effect.terms), enumerate(effect.joints)
        size, made = (
            n * len(effect.joints),
            (
                (k, n * place + m, x)
                for place, k in ((place, motion.joints.index(joint)) for place, joint in every)
                for m, x in enumerate(effect.per_joint(JointMotion.of(motion, k)))
            ),
        )
    else:
        rows = effect.columns(motion).transpose(1, 2, 0)
        size, made = rows.shape[1], ((k, c, rows[k, c]) for k in range(len(rows)) for c in range(rows.shape[1]))
    return size, (row for row in made if row[2].max(initial=0) != 0 or row[2].min(initial=0) != 0)


def prepare_segment(
    model: Model,
    log: Log,
    preparation: Preparation,
    *,
    signals: Mapping[str, np.ndarray] | None = None,
    needs: Iterable[str] = (),
    smooth_hz: float | None = None,
    rate_hz: float | None = None,
) -> PreparedSegment:
    """Filter, differentiate and gate one even stretch of a log.

    Args:
        model: Its effects decide at which speeds the gate shuts.
        log: An even stretch without gaps.
        preparation: Filters and masks.
        signals: Signals of the motion beyond those that the log's own columns give.
        needs: Names of computed signals wanted beyond those that the model's effects need.
        smooth_hz: Low-pass of the positions for speeds and accelerations [Hz], if these should be smoother than the direction
            of motion and the gate, which keep `preparation`'s; forces are then low-passed only once.
        rate_hz: Rate of the log [Hz], if it is part of a longer one whose rate is known better.
    """
    joints, rate = model.robot.actuated, rate_hz or log.rate_hz
    dt = 1 / rate
    raw, force = log.joint("q", joints), log.joint("tau", joints)
    q = lowpass(raw, preparation.position_cutoff_hz, rate)
    n_base = len(model.robot.base_coordinates)
    if n_base:
        q[:, :n_base] = lowpass(raw[:, :n_base], compute_base_cutoff(preparation, rate), rate)
    if smooth_hz is None:
        force = lowpass(force, preparation.position_cutoff_hz, rate)
    v = differentiate(q, dt, accuracy=4)
    a = differentiate(v, dt, accuracy=4)
    reported = force if smooth_hz is None else lowpass(force, preparation.position_cutoff_hz, rate)
    measured = get_measured_signals(log, joints, q, v, preparation.speed_threshold)
    measured = {**measured, REPORTED: reported, **(signals or {})}
    refuse_missing_temperature(model, log, measured)
    contacts = None
    if model.robot.base_coordinates:
        contacts, gate = compute_contact_gate(log, q, model, preparation, rate)
        sign = compute_expected_direction(v, preparation.speed_threshold / NOISE_FACTOR)
    else:
        gate = compute_gate(log, Motion.of(joints, q, v, a, signals=measured), model, preparation, rate)
        sign = np.sign(v)
    if smooth_hz is not None and smooth_hz < preparation.position_cutoff_hz:
        q = lowpass(raw, smooth_hz, rate)
        v = differentiate(q, dt, accuracy=4)
        a = differentiate(v, dt, accuracy=4)
    motion = model.motion(q, v, a, sign, t=log.t, signals=measured, needs=needs)
    factor = preparation.factor(rate)
    share = lowpass_and_decimate(gate, preparation.force_cutoff_hz, rate, factor)
    usable = share > np.where(np.arange(len(joints)) < n_base, MIN_SHARE, MIN_FLIGHT_SHARE if n_base else MIN_SHARE)
    edge = compute_edge_samples(preparation.force_cutoff_hz, rate)
    if smooth_hz is not None:
        edge = max(edge, compute_edge_samples(smooth_hz, rate))
    edge = int(np.ceil(edge / factor))
    usable[:edge] = usable[len(usable) - edge :] = False
    weight = np.where(usable, share, 1.0)
    return PreparedSegment(log, motion, force, gate, preparation, usable, weight, rate, contacts)


def _nothing_left(model: Model, logs: list[Log], preparation: Preparation) -> CannotAnswer:
    """Return why the gates leave no sample: saturated or flagged forces, or no steady motion."""
    robot = model.robot
    bad = np.concatenate(
        [find_excluded_samples(log, robot.actuated, robot.effort_limit, preparation.exclude) for log in logs]
    )
    if bad.mean() > 0.5:
        return CannotAnswer(
            "bad_sample",
            f"{100 * bad.mean():.0f} % of the forces are flagged or at the drives' limits "
            f"({', '.join(f'{x:g}' for x in robot.effort_limit)})",
            "check the units of tau and the effort limits in the robot file, or record a gentler motion",
        )
    return CannotAnswer(
        "poor_excitation",
        f"no joint moves steadily faster than its velocity noise ({_thresholds(preparation, model)})",
        f"move {', '.join(robot.actuated)} in both directions, over several speeds, for a minute or more",
    )


def _thresholds(preparation: Preparation, model: Model) -> str:
    units = model.robot.position_units
    return ", ".join(
        f"{j} {x:.2g} {u}/s" for j, x, u in zip(model.robot.actuated, preparation.speed_threshold, units, strict=True)
    )
