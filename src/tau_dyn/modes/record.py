"""Preparation of records from logs: pulse detection, removal of the operating point, held-out data, and checks.

A linear model describes deviations. Their origin is the mean of the training part of each record (the same for its
held-out part), a held-out log's own mean, and for an impulse test the level to which it decays. The held-out data are
the last 30 % of every record, the last 30 % of the pulses if there are several, or the given logs; they are used only
for validation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import (
    ChannelFault,
    Log,
    describe_missing_column,
    find_channel_faults,
    resample_segments,
    split_at_faults,
)
from tau_dyn.message_codes import CodedWarning


@dataclass(frozen=True, eq=False)
class Record:
    """One stretch of inputs and outputs.

    Attributes:
        u: Inputs (N, m); `m` is 0 if only a response was measured.
        y: Outputs (N, p).
        dt: Sampling step [s].
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        name: The log it came from.
        reference: Reference of a feedback loop (N, r); None if it was not logged.
        input_noise: Standard deviation of the noise of nonzero inputs (m,); None if it is neglected.
    """

    u: np.ndarray
    y: np.ndarray
    dt: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    name: str = ""
    reference: np.ndarray | None = None
    input_noise: np.ndarray | None = None

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.y)

    def window(self, part: slice) -> Record:
        """Return a stretch of it."""
        reference = None if self.reference is None else self.reference[part]
        return replace(self, u=self.u[part], y=self.y[part], reference=reference)

    def aligned(self, delay: int) -> Record:
        """Return it with the inputs acting `delay` samples later; the samples whose input is unknown are left out."""
        if delay == 0:
            return self
        if not 0 < delay < self.n_samples:
            raise InputError(
                "invalid_value",
                f"a delay of {delay} samples does not fit into {self.name or 'a record'} of {self.n_samples}",
            )
        reference = None if self.reference is None else self.reference[:-delay]
        return replace(self, u=self.u[:-delay], y=self.y[delay:], reference=reference)

    def scaled(self, scales: Scales) -> Record:
        """Return it with every column divided by its scale."""
        noise = None if self.input_noise is None else self.input_noise / scales.u
        return replace(self, u=self.u / scales.u, y=self.y / scales.y, input_noise=noise)


@dataclass(frozen=True, eq=False)
class Scales:
    """Root mean squares of the columns, which give different units equal weight in the computation.

    Attributes:
        u: Inputs (m,).
        y: Outputs (p,).
    """

    u: np.ndarray
    y: np.ndarray

    @property
    def log_size(self) -> float:
        """Log det of the outputs' covariance in units of the scaled one's."""
        return float(2 * np.sum(np.log(self.y)))

    @classmethod
    def of(cls, records: Sequence[Record]) -> Scales:
        """Measure records; a column of zeros counts as one of ones."""
        check_alike(records)

        def size(columns: Sequence[np.ndarray]) -> np.ndarray:
            squares = sum(np.einsum("ij,ij->j", part, part) for part in columns)
            mean = np.sqrt(squares / sum(map(len, columns)))
            return np.where(mean > 0, mean, 1.0)

        return cls(size([record.u for record in records]), size([record.y for record in records]))


def truncate_records(records: Sequence[Record], longest: int, least: int = 40) -> list[Record]:
    """Return the beginnings of records, about `longest` samples in all, `least` or more from each if it has them."""
    share = min(1.0, longest / sum(r.n_samples for r in records))
    return [r.window(slice(0, max(least, round(share * r.n_samples)))) for r in records]


def stack_lags(x: np.ndarray, lags: int, first: int = 1) -> np.ndarray:
    """Return x_{t-first}, .., x_{t-lags} (N - lags, .) side by side for t = lags .. N-1; no row of N up to lags."""
    n = max(len(x) - lags, 0)
    return np.hstack([x[lags - k : lags - k + n] for k in range(first, lags + 1)])


def check_alike(records: Sequence[Record]) -> None:
    """Refuse records that one model cannot explain together.

    Raises:
        InputError: There are no records, they differ in step or columns, or contain numbers that are not finite.
    """
    if not records:
        raise InputError("missing_input", "there is no record to identify from")
    first = records[0]
    for record in records:
        if abs(record.dt / first.dt - 1) > 1e-6:
            raise InputError(
                "time_stamps",
                f"records differ in sampling step: {first.dt:g} s and {record.dt:g} s; resample them to one rate",
            )
        if record.u.shape[1] != first.u.shape[1] or record.y.shape[1] != first.y.shape[1]:
            raise InputError("mismatch", "records differ in their number of inputs or outputs")
        if not (np.isfinite(record.u).all() and np.isfinite(record.y).all()):
            raise InputError(
                "bad_sample", f"{record.name or 'a record'} holds numbers that are not finite; cut it there"
            )


def build_records(
    log: Log, inputs: Sequence[str], outputs: Sequence[str], references: Sequence[str] = (), idle: Sequence[str] = ()
) -> list[Record]:
    """Return a log's unbroken stretches as records.

    Args:
        log: The log.
        inputs: Columns that excite.
        outputs: Columns that respond.
        references: Columns that a feedback loop was asked to follow.
        idle: Inputs that did not act and are no columns of this log.

    Raises:
        InputError: A column is missing, named twice, or never changes.
    """
    if idle:
        log = replace(log, channels={**log.channels, **{name: np.zeros(log.n_samples) for name in idle}})
    names = [*inputs, *outputs, *references]
    for name in names:
        if name not in log.channels:
            raise InputError("missing_column", describe_missing_column(log.name, name, tuple(log.channels)))
    for name in [*inputs, *outputs]:
        if names.count(name) > 1:
            raise InputError("duplicate_name", f"column '{name}' is named twice; each is an input or an output")
        if np.ptp(log.channels[name]) == 0 and name not in idle:
            raise InputError("poor_excitation", f"{log.name}: column '{name}' never changes")

    def stacked(piece: Log, columns: Iterable[str]) -> np.ndarray:
        return np.column_stack([np.zeros((piece.n_samples, 0)), *(piece.channels[name] for name in columns)])

    records = []
    for piece in resample_segments(log):
        u, y, asked = (stacked(piece, columns) for columns in (inputs, outputs, references))
        reference = asked if references else None
        records.append(Record(u, y, piece.dt, tuple(inputs), tuple(outputs), piece.name, reference))
    return records


TRAIN_SHARE = 0.7  # of each record; the rest is held out
STEADY_STATE_SHARE = 0.2  # last share of a pulse's record, whose mean is the level that it decays to
PULSE_SHARE = 0.03  # inputs that differ from rest for a smaller share of the time than this are pulses
PULSE_LEAD = 30  # samples of rest kept before a pulse: more than any delay that is tried
PULSE_ROOM = 100  # samples that a pulse's response needs, at least
SAMPLES_PER_CHANNEL = 40  # training samples for each input and output; fewer do not suffice to choose a model
PULSES = 10_000  # samples of all pulses together that are fitted to: the ends of long decays add little information
MAX_REST_SAMPLES = 20_000  # samples at a record's begin in which rest is searched
STEP_TOLERANCE = 1e-3  # relative difference of sampling rates that counts as one rate


@dataclass(frozen=True, eq=False)
class PreparedRecords:
    """Records ready for identification.

    Attributes:
        train: Training records.
        holdout: Held-out records for validation; empty if no data could be reserved.
        kind: `driven`, or `impulse` if each record is a short pulse and its decay.
        how_held: Description of the held-out data.
        warnings: Sentences.
        whole: Records for the final model: all data except logs given for validation; empty means `train`.
        clipped: Channels that clip; their residual is no property of the structure.
    """

    train: tuple[Record, ...]
    holdout: tuple[Record, ...]
    kind: str
    how_held: str
    warnings: tuple[str, ...] = ()
    whole: tuple[Record, ...] = ()
    clipped: tuple[str, ...] = ()

    @property
    def n_train(self) -> int:
        """Samples to fit on."""
        return sum(r.n_samples for r in self.train)


def prepare_records(
    logs: Sequence[Log],
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    holdout: Sequence[Log] = (),
    references: Sequence[str] = (),
) -> PreparedRecords:
    """Return training and held-out records.

    Args:
        logs: Logs to fit on.
        inputs: Columns that excite.
        outputs: Columns that respond.
        holdout: Logs for validation.
        references: Columns that a feedback loop was asked to follow.

    Raises:
        InputError: Columns are missing, constant, equal or hold no numbers, or the logs' steps differ.
        CannotAnswer: The logs are too short.
    """
    _refuse_names(inputs, outputs, references)
    idle = [_list_idle(log, inputs, logs) for log in (*logs, *holdout)]
    records = [
        _records(log, inputs, outputs, references, still) for log, still in zip((*logs, *holdout), idle, strict=True)
    ]
    faults = [find_channel_faults(log, inputs, outputs) for log in (*logs, *holdout)]
    records = [
        _leave_out(some, log, found, still, references)
        for some, log, found, still in zip(records, (*logs, *holdout), faults, idle, strict=True)
    ]
    train, held = ([r for some in part for r in some] for part in (records[: len(logs)], records[len(logs) :]))
    _refuse_records(train, held, len(inputs) + len(outputs))
    if any(idle) and not all(_is_pulses(r) for r in train):
        build_records(next(log for log, still in zip((*logs, *holdout), idle, strict=True) if still), inputs, outputs)
    known = {log.sha256 for log in logs if log.sha256}
    both = [log.name for log in holdout if log.sha256 in known or any(log is other for other in logs)]
    pieces = [piece for log in (*logs, *holdout) for piece in resample_segments(log)]
    warnings = (
        *dict.fromkeys(w for piece in pieces for w in piece.warnings),
        *(f"{name} is both trained on and held out; its errors are not held-out errors" for name in both),
        *(fault.warning for some in faults for fault in some),
        *(
            f"{log.name} has no column {', '.join(still)}: taken as zero, for the hammer was elsewhere"
            for log, still in zip((*logs, *holdout), idle, strict=True)
            if still
        ),
    )
    clipped = tuple(dict.fromkeys(fault.column for some in faults for fault in some if not fault.cut))
    return replace(_divide(train, held, warnings), clipped=clipped)


def _divide(train: list[Record], held: list[Record], warnings: tuple[str, ...]) -> PreparedRecords:
    """Return records as deviations from their operating points, with a part held out where no logs are."""
    if all(_is_pulses(r) for r in train):
        return _pulses(train, held, warnings)
    if held:
        parts, kept = (tuple(_centred(r, _origin(r)) for r in some) for some in (train, held))
        return PreparedRecords(parts, kept, "driven", "the logs given", warnings)
    cuts = [round(TRAIN_SHARE * r.n_samples) for r in train]
    origins = [_origin(r.window(slice(0, cut))) for r, cut in zip(train, cuts, strict=True)]
    whole = tuple(_centred(r, origin) for r, origin in zip(train, origins, strict=True))
    parts, kept = (
        tuple(r.window(slice(*span(cut))) for r, cut in zip(whole, cuts, strict=True))
        for span in (lambda cut: (0, cut), lambda cut: (cut, None))
    )
    return PreparedRecords(parts, tuple(r for r in kept if r.n_samples), "driven", "the last 30 %", warnings, whole)


def cut_pulses(record: Record) -> list[Record]:
    """Return a record of pulses cut before each of them, from rest on."""
    away = np.flatnonzero(_away(record))
    first = away[np.flatnonzero(np.diff(away, prepend=-record.n_samples) > PULSE_ROOM // 2)]
    edges = [*(max(0, int(k) - PULSE_LEAD) for k in first), record.n_samples]
    spans = [(a, b) for a, b in pairwise(edges) if b - a >= PULSE_ROOM]
    return [record.window(slice(a, b)) for a, b in spans]


def _away(record: Record) -> np.ndarray:
    """Return where an input is away from rest (N,) bool: by a twentieth of its peak, and more than its noise."""
    off = np.abs(record.u - np.median(record.u, axis=0))
    noise = 1.4826 * np.median(off, axis=0)
    return np.any(off > np.maximum(0.05 * off.max(axis=0), 6 * noise), axis=1)


def _is_pulses(record: Record) -> bool:
    return (
        record.n_samples >= 2 * PULSE_ROOM and bool(np.mean(_away(record)) < PULSE_SHARE) and bool(cut_pulses(record))
    )


def _pulses(train: list[Record], held: list[Record], warnings: tuple[str, ...]) -> PreparedRecords:
    cut = [p for r in train for p in cut_pulses(r)]
    drifts = _find_drifting(cut)
    if drifts.any():
        names = ", ".join(name for name, drifting in zip(train[0].outputs, drifts, strict=True) if drifting)
        said = f"{names} drifts from rest to rest of each pulse; a straight line between them is subtracted"
        warnings = (*warnings, CodedWarning("faulty_channel", said))
    pulses = [_settled(p, drifts) for p in cut]
    kept = [_settled(p, drifts) for r in held for p in (cut_pulses(r) if _is_pulses(r) else [r])]
    how, everything = "the logs given", pulses
    if not kept:
        pulses, kept = split_pulses(everything, 1 - TRAIN_SHARE)
        how = f"{len(kept)} of {len(everything)} pulses, the last ones at each place"
    if not kept:
        how = "nothing"
        few = "so few pulses leave no held-out data, so the fit is that of the data themselves; record each twice"
        warnings = (*warnings, few)
    parts, whole = (tuple(truncate_records(some, PULSES, 5 * PULSE_ROOM)) for some in (pulses, everything))
    return PreparedRecords(parts, tuple(kept), "impulse", how, warnings, whole)


def split_pulses(pulses: Sequence[Record], share: float) -> tuple[list[Record], list[Record]]:
    """Return pulses to fit on, and a share to compare on: the last ones at each place that was hit more than once.

    No pulses are reserved if the remaining ones would not excite every input separately.
    """
    peaks = np.array([np.abs(p.u).max(axis=0) for p in pulses])
    strongest = np.maximum(peaks.max(axis=0), 1e-300)
    place, apart = np.argmax(peaks / strongest, axis=1), np.zeros(len(pulses), bool)
    for k in np.unique(place):
        own = np.flatnonzero(place == k)
        if len(own) > 1:
            apart[own[len(own) - max(1, round(share * len(own))) :]] = True
    if np.linalg.matrix_rank(peaks[~apart] / strongest, tol=0.05) < peaks.shape[1]:
        apart[:] = False
    return [p for p, a in zip(pulses, apart, strict=True) if not a], [
        p for p, a in zip(pulses, apart, strict=True) if a
    ]


def _list_idle(log: Log, inputs: Sequence[str], logs: Sequence[Log]) -> tuple[str, ...]:
    """Return the inputs that this log lacks and another one has: places that a moving hammer hit in other logs."""
    missing = [name for name in inputs if name not in log.channels]
    elsewhere = all(any(name in other.channels for other in logs) for name in missing)
    return tuple(missing) if elsewhere and len(missing) < len(inputs) else ()


def _records(
    log: Log, inputs: Sequence[str], outputs: Sequence[str], references: Sequence[str], idle: Sequence[str]
) -> list[Record]:
    for name in (*inputs, *outputs, *references):
        bad = np.flatnonzero(~np.isfinite(log.channels.get(name, np.zeros(1))))
        if len(bad):
            raise InputError(
                "bad_sample",
                f"{log.name}: column '{name}' holds no number in {len(bad)} sample(s), first at t = {log.t[bad[0]]:.6g} s; "
                "mend them, or cut the log there",
            )
    records = build_records(log, inputs, outputs, references, idle)
    for i, one in enumerate(inputs):
        for j, other in enumerate(outputs):
            if all(_alike(r.u[:, i], r.y[:, j]) for r in records):
                raise InputError(
                    "mismatch",
                    f"{log.name}: output '{other}' is input '{one}' again, but for scale; name the measured response",
                )
    return records


def _leave_out(
    records: list[Record], log: Log, faults: Sequence[ChannelFault], idle: Sequence[str], references: Sequence[str]
) -> list[Record]:
    """Return the records of a log without its faulty stretches; of pulse tests those that still hold pulses.

    Raises:
        CannotAnswer: Nothing is left.
    """
    parts = split_at_faults(log, faults)
    if len(parts) == 1 and parts[0] is log or not records:
        return records
    inputs, outputs = records[0].inputs, records[0].outputs
    acting = [c for c in (*inputs, *outputs) if c not in idle]
    parts = [part for part in parts if all(np.ptp(part.channels[c]) > 0 for c in acting)]
    kept = [r for part in parts for r in build_records(part, inputs, outputs, references, idle)]
    if all(_is_pulses(r) for r in records):
        kept = [r for r in kept if _is_pulses(r)]
    if not kept:
        said = " ".join(fault.warning for fault in faults if fault.cut)
        raise CannotAnswer("too_little_data", f"{said} No usable stretch is left", "a record of working channels")
    return kept


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    a, b = a - a.mean(), b - b.mean()
    return bool(abs(a @ b) ** 2 > (1 - 1e-12) * (a @ a) * (b @ b))


def _refuse_names(inputs: Sequence[str], outputs: Sequence[str], references: Sequence[str]) -> None:
    if not outputs:
        raise InputError("bad_option", "no outputs are named; name the columns that respond with --outputs")
    if not inputs:
        raise InputError(
            "bad_option",
            "no inputs are named; resonances are identified from what excites the structure and what responds. "
            "Name the columns that excite with --inputs; responses alone go to find_operational_modes",
        )
    twice = [n for n in references if n in (*inputs, *outputs)]
    if twice:
        raise InputError(
            "duplicate_name",
            f"column '{twice[0]}' is a reference and also an input or output; a reference is what the loop was asked for",
        )


def _refuse_records(train: Sequence[Record], held: Sequence[Record], channels: int) -> None:
    """Refuse records that differ in their rate, or are too short."""
    if not (train or held):
        raise InputError("too_little_data", "every stretch between gaps is shorter than 10 samples; no record is left")
    first = [*train, *held][0]
    for r in (*train, *held):
        if abs(r.dt / first.dt - 1) > STEP_TOLERANCE:
            raise InputError(
                "time_stamps",
                f"{r.name} is sampled at {1 / r.dt:.6g} Hz and {first.name} at {1 / first.dt:.6g} Hz; "
                "one model needs one sampling rate",
            )
    n, needed = sum(r.n_samples for r in train), int(SAMPLES_PER_CHANNEL * channels / TRAIN_SHARE)
    if n < needed:
        raise CannotAnswer(
            "too_little_data",
            f"{n} samples are too few for {channels} channels",
            f"record at least {needed} samples, better ten times as many",
        )


def estimate_operating_point(record: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (m,) and outputs (p,) at rest: the inputs' mean, and the outputs that go with it.

    The means of inputs and outputs are not consistent, because outputs still oscillate at a record's ends; the
    difference would be modelled as a slow pole. A long ARX model with a constant gives the outputs at rest:
    y_t = c + sum A_k y_{t-k} + sum B_k u_{t-k}.
    """
    u, y = record.u[:MAX_REST_SAMPLES], record.y[:MAX_REST_SAMPLES]
    mean_u, mean_y, spread = record.u.mean(axis=0), record.y.mean(axis=0), record.y.std(axis=0)
    (n, m), p = u.shape, y.shape[1]
    lags = min(20, n // (20 * (m + p)))
    if lags < 2:
        return mean_u, mean_y
    du, dy = u - mean_u, (y - mean_y) / spread
    known = np.hstack([np.ones((n - lags, 1)), stack_lags(dy, lags), stack_lags(du, lags, 0)])
    theta = np.linalg.lstsq(known, dy[lags:], rcond=1e-9)[0]
    stiff = np.eye(p) - theta[1 : 1 + lags * p].reshape(lags, p, p).sum(axis=0).T
    if np.linalg.cond(stiff) > 1e6:
        return mean_u, mean_y
    rest = np.linalg.solve(stiff, theta[0])
    return mean_u, mean_y + np.where(np.abs(rest) < 1, rest, 0.0) * spread


def _origin(record: Record) -> Record:
    """Return a record's operating point as a record of one sample."""
    u, y = estimate_operating_point(record)
    reference = None if record.reference is None else record.reference.mean(axis=0)[None]
    return replace(record, u=u[None], y=y[None], reference=reference)


def _centred(record: Record, origin: Record) -> Record:
    """Return a record as deviations from an operating point."""
    reference = record.reference
    if reference is not None and origin.reference is not None:
        reference = reference - origin.reference
    return replace(record, u=record.u - origin.u, y=record.y - origin.y, reference=reference)


MIN_DRIFT_STDERR = 4.0
"""Difference of the levels of rest before and after a pulse, in standard errors, from which a sensor drifts."""
MIN_DRIFTING_PULSES = 3
"""Fewest pulses whose levels differ: after a single one a slow motion may not have decayed."""
MIN_REST_SAMPLES = 10  # samples of rest before a pulse; fewer give no level


def _find_drifting(pulses: Sequence[Record]) -> np.ndarray:
    """Return the outputs (p,) bool that drift during at least half of the pulses.

    A structure returns to the rest that it left. The standard error of a level is the scatter of means as long as the rest
    before the pulse, within the rest after it, so a structure that still rings is no drift.
    """
    found = [_compare_rests(p) for p in pulses]
    odd = np.array([np.abs(change) > MIN_DRIFT_STDERR * stderr for change, stderr in found])
    return (odd.sum(axis=0) >= MIN_DRIFTING_PULSES) & (odd.mean(axis=0) >= 0.5)


def _compare_rests(pulse: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return the change of the outputs' level (p,) from before a pulse to the end of its decay, and its standard error."""
    before, after = _list_rests(pulse)
    blocks = [
        after[k : k + len(before)].mean(axis=0) for k in range(0, len(after) - len(before) + 1, max(1, len(before)))
    ]
    if len(before) < MIN_REST_SAMPLES or len(blocks) < 3:
        return np.zeros(after.shape[1]), np.ones(after.shape[1])
    return after.mean(axis=0) - before.mean(axis=0), np.std(blocks, axis=0, ddof=1) + 1e-300


def _list_rests(pulse: Record) -> tuple[np.ndarray, np.ndarray]:
    """Return the outputs before a pulse, without the last third, in which its force may rise, and at the end of its decay."""
    first = int(np.argmax(_away(pulse)))
    return pulse.y[: 2 * first // 3], pulse.y[-max(10, int(STEADY_STATE_SHARE * pulse.n_samples)) :]


def _settled(record: Record, drifting: np.ndarray) -> Record:
    """Return a pulse and its decay as deviations from rest, or from a line between the rests of outputs that drift (p,)."""
    before, after = _list_rests(record)
    level = np.broadcast_to(after.mean(axis=0), record.y.shape)
    if drifting.any() and len(before) >= MIN_REST_SAMPLES:
        start, end = 0.5 * len(before), record.n_samples - 0.5 * len(after)
        share = (np.arange(record.n_samples)[:, None] - end) / (end - start)
        level = level + np.where(drifting, share * (after.mean(axis=0) - before.mean(axis=0)), 0.0)
    return replace(record, u=record.u - np.median(record.u, axis=0), y=record.y - level)
