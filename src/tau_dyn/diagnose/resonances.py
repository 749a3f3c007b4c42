r"""Resonances that a residual shows: a black-box fit of it against the force that springs would carry proposes modes.

The contribution of a compliant structure to forces, or to the tool position, is a linear response to the force F of the rigid
bodies,

    residual = G(s) F + D F + noise,     G with the poles of the structure,

and a low-pass common to both sides does not change G. So the subspace method of `modes/` and its refinement, on the training
part alone, give the number of modes, their frequencies and their damping; the search (`effects/structural_compliance.py`) then
rates them like any other setting, together with all other causes. D absorbs the changes of the baseline's refit. Orders are
compared by BIC, including no mode at all; a mode whose frequency or damping is poorly determined is not proposed. Reference:
Ljung 1999, 16.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from tau_dyn.diagnose.force_channel import ForceChannel
from tau_dyn.diagnose.tool_channel import ToolChannel, restrict_to_group
from tau_dyn.effects import StructuralCompliance
from tau_dyn.estimate import scale_columns, solve_scaled
from tau_dyn.evidence import (
    TRAIN,
    Channel,
    Finding,
)
from tau_dyn.exceptions import TauDynError
from tau_dyn.log import find_true_runs
from tau_dyn.modes import (
    Mode,
    Record,
    RefinedModel,
    RefinementPath,
    compress_subspace_data,
    compute_aic_bic,
    compute_log_det_loss,
    count_free_parameters,
    descend_to_fit,
    stabilise_poles,
)
from tau_dyn.parameters import Parameter

ORDERS = (2, 4, 6, 8)
MIN_FREQUENCY_HZ = 3.0
"""Lowest frequency [Hz] of a mode: below, friction and drift resemble modes."""
HEAVIEST = 0.3
"""Damping ratio above which a mode does not resonate."""
KNOWN = (0.02, 0.5)
"""Largest standard errors of frequency and damping, as shares of them, of a mode that is proposed."""
MIN_SEGMENT_S = 2.0
"""Least length of stretches without a reversal in which a mode's oscillation is observable [s]."""
MAX_SAMPLES = 20_000  # of the records that resonances are fitted to; bounds time
ALONE = 0.95
"""Share of the statistic of a full matrix from which on a single joint's compliance is the simpler explanation."""
_REACH = 1.25
"""Frequency up to which modes are proposed, as a multiple of that up to which the motion exceeds noise; resonances above it are
artefacts of noise."""
_MAX_ITERATIONS = 15  # of the refinement of a proposed resonance
_CAUSE = "structural_compliance"
_SPREAD = 2.0  # standard errors of a frequency
_BEYOND = (
    " That is above the {band} up to which the encoders show the motion, so it is extrapolated from the response below."
)
_WANTED = (
    "record an accelerometer at the tool, or motion with a multisine around {frequency} above the encoders' noise, "
    "sampled at {rate} or more"
)


C = TypeVar("C", bound=Channel)


def add_resonances(channel: C) -> C:
    """Return a channel whose scene proposes the resonances that its training part shows."""
    found = replace(channel, scene=replace(channel.scene, resonances=propose_resonances(channel)))
    if not found.scene.resonances or not _of_structure(found):
        return found
    causes = found.causes
    if isinstance(channel, ToolChannel):  # there each group is a separate cause
        others = (cls for cls in causes if cls.name != _CAUSE)
        causes = (*others, restrict_to_group(channel.scene.joints, StructuralCompliance))
    return replace(found, scene=replace(found.scene, structure=True), causes=causes)


def _of_structure(channel: Channel) -> bool:
    """Return whether proposed modes are more than any single joint's: each joint explains clearly less than a full matrix."""
    scene = channel.scene
    if len(scene.joints) < 2:
        return False
    alone = [(joint,) for joint in scene.joints]
    effects = [StructuralCompliance.of_resonances(scene, g) for g in (*alone, scene.joints)]
    nothing, *singles, whole = _missed(channel, [None, *effects])
    return nothing - min(singles) < ALONE * (nothing - whole)


def _missed(channel: Channel, effects: Sequence[StructuralCompliance | None]) -> list[float]:
    """Return the residual of the training part, with each effect or without, each output divided by its own size."""
    masks = channel.masks(TRAIN)

    def rows(arrays: Sequence[np.ndarray]) -> np.ndarray:
        scaled = [x / s if x.ndim == 2 else x / s[:, None] for x in arrays]
        return np.concatenate([x[m] for x, m in zip(scaled, masks, strict=True)])

    s = np.array([np.std(np.concatenate([y[m[:, k], k] for y, m in zip(channel.target, masks, strict=True)]))
                  for k in range(len(channel.outputs))])  # fmt: skip
    s[~(s > 0)] = 1.0
    y, W, found = rows(channel.target), rows(channel.free_columns), []
    for effect in effects:
        C = W if effect is None else np.concatenate([W, rows(channel.columns(effect))], axis=1)
        unit, _ = scale_columns(C)
        left = y - unit @ np.linalg.lstsq(unit, y, rcond=1e-9)[0]
        found.append(float(left @ left))
    return found


def propose_resonances(channel: Channel) -> tuple[tuple[float, float], ...]:
    """Return frequency [Hz] and damping ratio of the modes in the training part, the best determined first."""
    records = _records(channel)
    best = _most_likely(records) if records else None
    if best is None:
        return ()
    top = min(channel.scene.cutoff_hz, _REACH * _clear_hz(channel), 0.4 / records[0].dt)
    rings = [m for m in best.modes if _known(m) and MIN_FREQUENCY_HZ < m.frequency_hz < top]
    rings.sort(key=lambda m: m.frequency_stderr / m.frequency_hz)
    apart = [m for k, m in enumerate(rings) if not any(_one(m, other) for other in rings[:k])]
    return tuple((m.frequency_hz, m.damping_ratio) for m in apart)


def _clear_hz(channel: Channel) -> float:
    """Return the frequency up to which the motion exceeds the encoders' noise; forces share that noise."""
    if not isinstance(channel, ForceChannel):
        return np.inf
    return min(float(piece.motion.signals["clear_hz"][0]) for piece in channel.prepared)


def _one(a: Mode, b: Mode) -> bool:
    """Return whether two modes are within half their resonance's width: one matrix represents both shapes."""
    return abs(a.frequency_hz - b.frequency_hz) < a.damping_ratio * a.frequency_hz / 2


def _known(mode: Mode) -> bool:
    """Return whether a mode is underdamped and well determined; unknown errors are nan and fail."""
    frequency, damping = (share * x for share, x in zip(KNOWN, (mode.frequency_hz, mode.damping_ratio), strict=True))
    return 0 < mode.damping_ratio < HEAVIEST and mode.frequency_stderr < frequency and mode.damping_stderr < damping


def _most_likely(records: Sequence[Record]) -> RefinedModel | None:
    """Return the best model by BIC; None if a static response or no response is better."""
    p, m = records[0].y.shape[1], records[0].u.shape[1]
    n = sum(r.n_samples for r in records)
    least = compute_aic_bic(
        compute_log_det_loss(_at_once(records)), n, count_free_parameters(0, p, m, direct=True, predicts=False)
    )[1]
    better: list[tuple[float, RefinementPath]] = []
    try:
        factors = compress_subspace_data(records)
    except (TauDynError, np.linalg.LinAlgError):
        return None
    for order in (o for o in ORDERS if o <= factors.largest_order):
        try:
            start = stabilise_poles(factors.model(order, direct=True))
            found = descend_to_fit(start, records, direct=True, maximum_rounds=_MAX_ITERATIONS)
        except (TauDynError, np.linalg.LinAlgError):
            continue
        freedom = count_free_parameters(order, p, m, direct=True, predicts=False)
        bic = compute_aic_bic(found.loss, found.path.state.n_samples, freedom)[1]
        if np.isfinite(bic) and bic < least:
            better.append((bic, found))
    for _, found in sorted(better, key=lambda pair: pair[0]):
        try:
            return found.finish()  # uncertainties of the best alone
        except (TauDynError, np.linalg.LinAlgError):
            continue
    return None


def _at_once(records: Sequence[Record]) -> list[np.ndarray]:
    """Return the residual of a static response to the force."""
    u, y = (np.concatenate([getattr(r, key) for r in records]) for key in "uy")
    D = np.linalg.lstsq(u, y, rcond=1e-9)[0]
    return [r.y - r.u @ D for r in records]


def _records(channel: Channel) -> list[Record]:
    """Return the training part's unbroken stretches: rigid-body forces as input, residual as output.

    Stretches end where a joint reverses, unless less than half of the samples would remain: then friction's jumps are kept.
    """
    if not isinstance(channel, ForceChannel | ToolChannel):
        return []
    pieces = channel.prepared if isinstance(channel, ForceChannel) else channel.pieces
    theta = _baseline(channel)
    sure, whole = [], []
    for run, part, piece in zip(channel.runs, channel.parts, pieces, strict=True):
        signals = piece.motion.signals
        F = signals.get("wide_force", signals.get("rigid_force"))
        if F is None or piece.motion.t is None or len(run.t) < 2:
            continue
        u, e = piece.passed(F), run.y_all - run.W_all @ theta
        dt = float(run.t[-1] - run.t[0]) / (len(run.t) - 1)
        train = part == TRAIN
        whole += _stretches(channel, u, e, train, dt)
        sure += _stretches(channel, u, e, train & run.usable.all(axis=1), dt)
    kept = sure if sum(r.n_samples for r in sure) > 0.5 * sum(r.n_samples for r in whole) else whole
    return list(_few(kept))


def _baseline(channel: Channel) -> np.ndarray:
    """Return the baseline's values (p,) by plain least squares on the training part."""
    masks = channel.masks(TRAIN)
    W = np.concatenate([c[m] for c, m in zip(channel.free_columns, masks, strict=True)])
    y = np.concatenate([x[m] for x, m in zip(channel.target, masks, strict=True)])
    theta = np.array(channel.parameters.values)
    theta[channel.parameters.free] = solve_scaled(W, y, 1e-9)
    return theta


def _stretches(channel: Channel, u: np.ndarray, e: np.ndarray, mask: np.ndarray, dt: float) -> Iterator[Record]:
    """Return unbroken stretches of samples (n,) that are long enough, as deviations from their means."""
    for part in find_true_runs(mask):
        if (part.stop - part.start) * dt >= MIN_SEGMENT_S:
            one, other = u[part] - u[part].mean(axis=0), e[part] - e[part].mean(axis=0)
            yield Record(one, other, dt, channel.scene.joints, channel.outputs)


def _few(records: Sequence[Record]) -> Iterator[Record]:
    """Return records of one clock until they hold enough samples."""
    total = 0
    for record in records:
        if total < MAX_SAMPLES and abs(record.dt / records[0].dt - 1) < 1e-6:
            total += record.n_samples
            yield record


def add_band_note(finding: Finding, band_hz: float) -> Finding:
    """Return a finding, with a note on the data needed if its resonance is above the band that the encoders resolve.

    Frequency and damping of such a resonance are unreliable and lose their standard errors: true springs at 55 and 93 Hz were
    estimated as 14.7 +- 0.1 and 18.6 +- 1.3 Hz from encoders that resolved 13 and 15 Hz.

    Args:
        finding: Any finding.
        band_hz: Frequency up to which the motion clearly exceeds the encoders' noise [Hz].
    """
    if finding.cause != _CAUSE:
        return finding
    highest = max((p for p in finding.parameters if ".frequency" in p.name), key=lambda p: p.value, default=None)
    if highest is None or not _beyond(highest, band_hz):
        return finding
    said = _BEYOND.format(band=f"{band_hz:.3g} Hz")
    wanted = _WANTED.format(frequency=f"{highest.value:.3g} Hz", rate=f"{10 * highest.value:.2g} Hz")
    experiment = f"{finding.experiment}; {wanted}" if finding.experiment else wanted
    guessed = {
        p.name.replace(".frequency", what)
        for p in finding.parameters
        if ".frequency" in p.name and _beyond(p, band_hz)
        for what in (".frequency", ".damping")
    }
    known = tuple(replace(p, stderr=None) if p.name in guessed else p for p in finding.parameters)
    return replace(finding, sentence=finding.sentence + said, experiment=experiment, parameters=known)


def _beyond(frequency: Parameter, band_hz: float) -> bool:
    return frequency.value - _SPREAD * (frequency.stderr or 0.0) >= band_hz
