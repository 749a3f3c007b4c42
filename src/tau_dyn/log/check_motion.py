"""The motion of each joint: encoder, range, speeds, reversals, acceleration above noise, lag behind the reference.

Part of `check.py`. Velocities are those an identification would use: zero-phase low-pass, then central differences.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.signal import correlate

from tau_dyn.log.filtering import (
    compute_edge_samples,
    compute_noise_gain,
    differentiate,
    estimate_encoder_noise,
    estimate_quantisation_step,
    find_reversals,
    lowpass,
)
from tau_dyn.log.log import Log
from tau_dyn.log.resample import find_true_runs
from tau_dyn.log.signal_checks import FORCE_S, CheckFinding, FrozenStretch, choose_finding, find_jumps
from tau_dyn.message_codes import CodedWarning
from tau_dyn.results import count

CUTOFF_SHARE = 0.06
"""Low-pass for judging a motion, as a share of the sampling rate: 60 Hz at 1 kHz."""

_CROSSED = 0.1
"""Velocity error against another joint's reference, over that against its own, below which a joint follows the other one."""

MIN_REVERSALS = 4
"""Fewer changes of direction hardly separate friction from inertia."""


def compute_motion_cutoff(log: Log) -> float:
    """Return the cutoff [Hz] of the low-pass used for judging a motion: 60 Hz, less for slow clocks."""
    return min(60.0, CUTOFF_SHARE * log.rate_hz) if log.rate_hz >= 250.0 else 0.2 * log.rate_hz


def compute_velocities(log: Log, signal: str, joint: str) -> NDArray[np.float64]:
    """Return the filtered velocity (N,) of one joint's `q` or `q_ref`, from an even log."""
    q = log.channels[f"{signal}_{joint}"]
    cutoff = compute_motion_cutoff(log)
    filtered = lowpass(q, cutoff, log.rate_hz) if len(q) > compute_edge_samples(cutoff, log.rate_hz) else q
    return differentiate(filtered, log.dt)


def find_moving_samples(log: Log, joint: str) -> NDArray[np.bool_]:
    """Return the samples (N,) in which a joint moves, by its reference if there is one, else by its position."""
    signal = "q_ref" if log.has("q_ref", [joint]) else "q"
    v = compute_velocities(log, signal, joint)
    return np.abs(v) > max(_noise_speed(log, signal, joint), 0.02 * float(np.abs(v).max()))


DEAD_WINDOW_S = 1.0
"""Windows in which a force is compared with the acceleration of its joint [s]; a joint of a robot turns several times."""

MIN_DEAD_WINDOWS = 3
"""Least number of consecutive windows without a force."""

MIN_ACTIVE_SHARE = 0.3
"""Acceleration in a window, as a share of that of the whole log, from which a live force has to vary."""

MIN_FORCE_GAP = 5.0
"""Ratio of force to acceleration in live windows over that in dead ones; other joints and slow motions change it gradually."""

MAX_DEAD_COHERENCE = 0.1
"""Share of a dead force's power that the joint's own position, velocity, acceleration and direction explain by chance."""


def find_dead_force(log: Log, joint: str) -> list[FrozenStretch]:
    """Return the stretches in which a joint's force is a constant with noise, while the joint accelerates as elsewhere.

    An inertia needs a force, so the spread of a force averaged over 0.1 s, divided by that of the acceleration, has a lower bound
    in each window. A dead channel falls below it by a gap, and no motion of its joint explains what is left.
    """
    width, n = max(1, round(FORCE_S * log.rate_hz)), max(1, round(DEAD_WINDOW_S * log.rate_hz))
    count = log.n_samples // n
    if count < 4 * MIN_DEAD_WINDOWS:
        return []
    v = compute_velocities(log, "q", joint)
    a, tau, box = differentiate(v, log.dt), log.channels[f"tau_{joint}"], np.ones(width) / width
    force, pull = (np.convolve(x, box, "same")[: count * n].reshape(count, n).std(axis=1) for x in (tau, a))
    active = pull > MIN_ACTIVE_SHARE * float(np.sqrt(np.mean(pull**2)))
    ratio = np.where(active, force / np.maximum(pull, 1e-300), np.nan)
    known = np.sort(ratio[active])
    steps = (
        known[1:] / np.maximum(known[:-1], max(1e-12 * known[-1], 1e-300))
        if len(known) > MIN_DEAD_WINDOWS
        else np.zeros(0)
    )
    if not steps.size or steps.max() < MIN_FORCE_GAP:
        return []
    low = np.isnan(ratio) | (ratio <= known[int(np.argmax(steps))])
    X = np.column_stack([np.ones(log.n_samples), log.channels[f"q_{joint}"], v, a, np.sign(v)])
    found = []
    for first, last in _list_runs(low):
        if np.count_nonzero(active[first:last]) < MIN_DEAD_WINDOWS:
            continue
        inside = slice(first * n, last * n)
        x = tau[inside] - tau[inside].mean()
        left = x - X[inside] @ np.linalg.lstsq(X[inside], x, rcond=None)[0]
        if left @ left < (1 - MAX_DEAD_COHERENCE) * (x @ x) or not np.any(tau[inside]):  # zeros: a drive that is off
            continue
        start, stop = _extend_stretch(tau, inside)
        state = f"is {tau[inside].mean():.3g} with noise of {x.std():.2g} and nothing else"
        found.append(FrozenStretch(f"tau_{joint}", start, stop, f"{joint} accelerates as elsewhere", state))
    return found


def _list_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first element and end of each run of true elements (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _extend_stretch(x: NDArray[np.float64], inside: slice) -> tuple[int, int]:
    """Return first sample and end of the stretch in which a channel (N,) stays within five deviations of its mean inside."""
    off = np.abs(x - x[inside].mean()) > 5 * x[inside].std()
    before, after = np.flatnonzero(off[: inside.start]), np.flatnonzero(off[inside.stop :])
    return int(before[-1]) + 1 if before.size else 0, inside.stop + int(after[0]) if after.size else len(x)


MEAN_S = 0.02
"""Time over which a force is averaged before its extreme is sought [s]: excursions of a robot's force take longer."""

BAND = 7.0
"""Width of the band of a limit with noise on it, in standard deviations of the averaged noise: its extremes are 3.5 off."""

MIN_CROWDING = 8.0
"""Samples in the band over a fourth of those in the next four bands; the top of a parabola has 3.2, see `channel_health.py`."""

MIN_EXCURSIONS = 3
"""Least number of excursions to a limit."""

MIN_EXCESS_RATIO = 3.0
"""Force beyond the limit that the motion requires, on average over excursions, over the rms residual of the other samples."""


def find_clipped_force(log: Log, joint: str) -> CodedWarning | None:
    """Return a warning about a force that is measured as a constant with noise while the motion requires more, else None.

    A force that a sensor or amplifier clips crowds at its extreme. A drive at its limit does so too, and a constant acceleration
    requires a constant force; there the motion agrees with the measured force. The force that the motion requires is a linear
    function of accelerations, velocities, directions and products of sines and cosines of all positions, fitted to the other
    samples.

    Args:
        log: The log, evenly sampled or nearly so.
        joint: The joint.
    """
    tau = log.channels[f"tau_{joint}"]
    width = max(3, round(MEAN_S * log.rate_hz))
    noise = float(estimate_encoder_noise(tau)) / np.sqrt(width)
    if log.n_samples < 50 * width or noise == 0:
        return None
    mean = np.convolve(tau, np.ones(width) / width, "same")
    mean[:width] = mean[-width:] = np.median(mean)
    for side in (1.0, -1.0):
        below = float((side * mean).max()) - side * mean
        runs = [r for r in find_true_runs(below <= BAND * noise) if r.stop - r.start >= 2 * width]
        inside = sum(r.stop - r.start for r in runs)
        beside = np.count_nonzero((below > BAND * noise) & (below <= 5 * BAND * noise)) / 4
        if len(runs) < MIN_EXCURSIONS or inside < MIN_CROWDING * max(beside, 1.0):
            continue
        beyond, stderr, residual = _measure_excess(log, side * tau, below > BAND * noise, runs)
        if beyond > MIN_EXCESS_RATIO * max(stderr, residual):
            return _describe_clipped(log, joint, runs, beyond)
    return None


def _describe_clipped(log: Log, joint: str, runs: Sequence[slice], excess: float) -> CodedWarning:
    tau = log.channels[f"tau_{joint}"]
    level = float(np.median(np.concatenate([tau[r] for r in runs])))
    share = 100 * sum(r.stop - r.start for r in runs) / log.n_samples
    return CodedWarning(
        "faulty_channel",
        f"{log.name}: tau_{joint} clips at {level:.4g} in {share:.2g} % of the samples, first at t = {log.t[runs[0].start]:.4g} "
        f"s: it is constant with noise there, although the motion requires {excess:.2g} more on average. Forces and parameters "
        "are biased. Widen the range of the sensor or amplifier, or record a gentler motion.",
    )


def _measure_excess(
    log: Log, tau: NDArray[np.float64], use: NDArray[np.bool_], runs: Sequence[slice]
) -> tuple[float, float, float]:
    """Return the mean force over runs that the motion requires beyond a measured one (N,), its standard error, and the residual.

    The required force is fitted by least squares to the samples to use (N,). A motion that these do not show makes the standard
    error large: residuals count as correlated over 0.1 s, and directions without data as unknown.
    """
    columns, parts = [np.ones(log.n_samples)], []
    for joint in log.joints("q"):
        q, v = log.channels[f"q_{joint}"], compute_velocities(log, "q", joint)
        parts += [np.sin(q), np.cos(q)]
        columns += [differentiate(v, log.dt), v, np.sign(v)]
    columns += parts + [one * other for k, one in enumerate(parts) for other in parts[k + 1 :]]
    X = np.column_stack(columns)
    X /= np.maximum(np.linalg.norm(X[use], axis=0), 1e-300)
    U, values, Vt = np.linalg.svd(X[use], full_matrices=False)
    known = values > _MIN_SHOWN_SHARE * values[0]
    free = int(np.count_nonzero(use)) / max(1.0, FORCE_S * log.rate_hz) - np.count_nonzero(known)
    at = np.mean([X[r].mean(axis=0) for r in runs], axis=0)
    along = Vt @ at
    unknown = np.linalg.norm(at - Vt[known].T @ along[known])
    if free <= 0 or unknown > _MAX_UNKNOWN_SHARE * np.linalg.norm(at):
        return 0.0, np.inf, np.inf
    amplitude = (U[:, known].T @ tau[use]) / values[known]
    residual = np.sqrt(np.sum((tau[use] - U[:, known] @ (values[known] * amplitude)) ** 2) / np.count_nonzero(use))
    spread = residual * np.sqrt(FORCE_S * log.rate_hz) * np.linalg.norm(along[known] / values[known])
    beyond = float(along[known] @ amplitude - np.mean([tau[r].mean() for r in runs]))
    return beyond, float(spread), float(residual)


_MIN_SHOWN_SHARE = 1e-6
"""Least singular value of the samples without a limit, as a share of the largest, of a direction that they show."""
_MAX_UNKNOWN_SHARE = 1e-2
"""Largest share of the motion at a limit in directions that the other samples do not show."""

MIN_SLIP_RATIO = 10.0
"""Size of a slip over the sixth largest departure of a step from the steps around it; an encoder slips a few times at most."""

MIN_SLIP_COUNTS = 3.0
"""Least size of a slip in counts of its encoder."""

MIN_SLIP_SHARE = 1e-3
"""Least size of a slip, as a share of the joint's range."""

LOST_STEPS = np.array([-1, 1, 2, 3, 4, 5])
"""Steps that a repeated sample or lost samples add, to within a fourth of a step."""


def find_slip(log: Log, joint: str) -> CodedWarning | None:
    """Return a warning about positions that step against the motion before and after, else None.

    A coupling or an encoder that slips moves the position within one sample, while the steps on both sides go on alike. An impact
    changes the steps on one side; lost samples make a whole number of steps.
    """
    q = log.channels[f"q_{joint}"]
    step = np.diff(q)
    if len(step) < 100 or find_jumps(q).size:
        return None
    before, after = (step[:-6] + step[1:-5]) / 2, (step[5:-1] + step[6:]) / 2
    off = np.stack([step[3:-3] - before, step[3:-3] - after])
    kept = step[2:-4] + step[3:-3] + step[4:-2] - 1.5 * (before + after)  # a single wrong reading comes back
    size = np.abs(off).min(axis=0)
    size = np.where((off[0] * off[1] > 0) & (kept * off[0] > 0) & (np.abs(kept) > size / 2), size, 0.0)
    usual = float(np.sort(size)[-6])
    least = max(
        MIN_SLIP_RATIO * usual,
        MIN_SLIP_COUNTS * float(estimate_quantisation_step(q)),
        MIN_SLIP_SHARE * float(np.ptp(q)),
    )
    steps = off.mean(axis=0) / np.where(before + after == 0, np.inf, (before + after) / 2)
    lost = np.any(np.abs(steps[:, None] - LOST_STEPS) < 0.25, axis=1)
    even = np.convolve(np.diff(log.t) < 1.5 * log.dt, np.ones(7), "valid") > 6  # none of the seven steps is a gap
    found = np.flatnonzero((size > least) & even & ~lost)
    if not found.size or usual == 0:
        return None
    at = found[0] + 3
    return CodedWarning(
        "faulty_channel",
        f"{log.name}: q_{joint} steps by {off[:, found[0]].mean():+.3g} within one sample after t = {log.t[at]:.6g} s, while the "
        f"joint moves on as before: the encoder or its coupling slipped{_count_more(found.size)}. Cut the log there, and use the "
        "parts as two logs; their zeros differ.",
    )


def _count_more(n: int) -> str:
    return f" ({n} times in the log)" if n > 1 else ""


MIN_STUCK_PERIODS = 4
"""Least number of a bit's periods in the range of an encoder: elsewhere its motion alone may avoid half of a period."""

MIN_BACKWARD = 3
"""Least number of steps against the motion of half a bit's size or more; a coarse encoder steps along the motion."""


def find_stuck_bit(log: Log, joint: str) -> CodedWarning | None:
    """Return a warning about an encoder one of whose bits never changes, else None.

    The counts modulo 2^(k+1) of a moving joint take all values. If bit k is stuck they take one half of them, and the position
    goes back by 2^k counts where a carry is lost.
    """
    q = log.channels[f"q_{joint}"]
    step = float(estimate_quantisation_step(q))
    if not step:
        return None
    counts = np.round((q - q.min()) / step).astype(np.int64)
    steps = np.diff(counts)
    way = np.sign(median_filter(steps, 5))
    for k in range(2, 40):
        period = 2 ** (k + 1)
        if MIN_STUCK_PERIODS * period > counts.max():
            return None
        seen = np.unique(counts % period)
        widest = int(np.diff(np.append(seen, seen[0] + period)).max())
        back = -way * steps
        if widest > period // 2 and np.count_nonzero((back >= period // 4) & (back <= period)) >= MIN_BACKWARD:
            return CodedWarning(
                "faulty_channel",
                f"{log.name}: a bit of q_{joint} is stuck: the position takes only one half of the values in each "
                f"{period * step:.4g}, and jumps back by up to {period // 2 * step:.4g} against the motion. Positions are wrong "
                "by up to that; look at the encoder, its cable and the decoding of its bits.",
            )
    return None


def check_motion(
    log: Log, others: Sequence[Log] = (), units: Mapping[str, str] | None = None
) -> tuple[list[CheckFinding], dict[str, Any]]:
    """Judge the motion of every joint with a `q`.

    Args:
        log: A log with an even clock.
        others: Other parts of the same log, whose range, speed and reversals count as well.
        units: Unit of a joint's position, m or rad, by joint; sentences about other joints have none.

    Returns:
        Findings, and by joint: `quantisation`, `encoder_noise` [m or rad], `velocity_noise` [per s], `range`, `speed`
        (smallest and largest), `n_reversals`, `forward_share`, `acceleration_rms`, `acceleration_noise` [per s^2] and
        `lag` behind `q_ref` [s].
    """
    findings: list[CheckFinding] = []
    numbers: dict[str, dict[str, Any]] = {}
    crossed = _check_swapped_columns(log)
    for joint in log.joints("q"):
        figures = _add_parts(_figures(log, joint), [_figures(other, joint) for other in others])
        numbers[joint] = figures
        follows = crossed[joint] if joint in crossed else _lag(log, joint, figures)
        unit = (units or {}).get(joint, "")
        findings += [_encoder(log, joint, figures, unit), _excitation(log, joint, figures, unit), follows]
    if numbers and not any(figures["moves"] for figures in numbers.values()):
        remedy = "Record a motion, such as `tau-dyn excite` makes."
        findings.append(CheckFinding("fault", "excitation", f"{log.name}: no joint moves.", remedy))
    return findings, {"joints": numbers}


def estimate_reference_lag(log: Log, joint: str) -> float:
    """Return the lag [s] of a joint's position behind its reference; negative if it runs ahead.

    The lag minimises the squared difference between both velocities within 0.25 s, refined by a parabola.
    """
    reference, actual = (compute_velocities(log, kind, joint) for kind in ("q_ref", "q"))
    reach = min(max(int(0.25 * log.rate_hz), 2), log.n_samples // 3)
    inner = actual[reach : log.n_samples - reach]
    products = correlate(reference, inner, mode="valid", method="fft")
    energy = np.concatenate(([0.0], np.cumsum(reference**2)))
    misfit = (energy[len(inner) :] - energy[: -len(inner)] - 2 * products)[::-1]
    k = int(np.argmin(misfit))
    if k in (0, len(misfit) - 1):
        return float((k - reach) * log.dt)
    left, low, right = misfit[k - 1 : k + 2]
    return float((k - reach + 0.5 * (left - right) / (left - 2 * low + right)) * log.dt)


def _figures(log: Log, joint: str) -> dict[str, Any]:
    q = log.channels[f"q_{joint}"]
    v = compute_velocities(log, "q", joint)
    a = differentiate(v, log.dt)
    cut = min(compute_edge_samples(compute_motion_cutoff(log), log.rate_hz), log.n_samples // 4)
    inner = slice(cut, log.n_samples - cut)
    noise = float(estimate_encoder_noise(q))
    gains = [compute_noise_gain(log.rate_hz, compute_motion_cutoff(log), derivatives=d) for d in (1, 2)]
    fast = np.abs(v[inner]) > max(5 * noise * gains[0], 0.02 * float(np.abs(v[inner]).max()), 1e-12)
    speeds = np.abs(v[inner])[fast]
    return {
        "moves": bool(np.ptp(q) > max(20 * noise, 3 * float(estimate_quantisation_step(q)), 1e-9) and speeds.size > 0),
        "quantisation": float(estimate_quantisation_step(q)),
        "encoder_noise": noise,
        "velocity_noise": noise * gains[0],
        "range": [float(q.min()), float(q.max())],
        "speed": [float(np.median(speeds)), float(speeds.max())] if speeds.size else [0.0, 0.0],
        "n_reversals": len(find_reversals(v[inner], max(5 * noise * gains[0], 0.02 * float(np.abs(v[inner]).max())))),
        "forward_share": float(np.mean(v[inner][fast] > 0)) if speeds.size else 0.0,
        "acceleration_rms": float(np.sqrt(np.mean(a[inner] ** 2))),
        "acceleration_noise": noise * gains[1],
        "lag": estimate_reference_lag(log, joint) if log.has("q_ref", [joint]) and speeds.size else None,
    }


def _add_parts(figures: dict[str, Any], others: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a joint in the longest part of a log, with the range, speed and reversals of all parts."""
    parts = [figures, *others]
    return figures | {
        "moves": any(part["moves"] for part in parts),
        "range": [min(part["range"][0] for part in parts), max(part["range"][1] for part in parts)],
        "speed": [figures["speed"][0], max(part["speed"][1] for part in parts)],
        "n_reversals": sum(part["n_reversals"] for part in parts),
    }


def _noise_speed(log: Log, signal: str, joint: str) -> float:
    noise = float(estimate_encoder_noise(log.channels[f"{signal}_{joint}"]))
    return 5 * noise * compute_noise_gain(log.rate_hz, compute_motion_cutoff(log))


def _encoder(log: Log, joint: str, f: dict[str, Any], unit: str) -> CheckFinding:
    shown, speed = (f" {unit}", f" {unit}/s") if unit else ("", " a second")
    step = f"steps of {f['quantisation']:.3g}{shown}" if f["quantisation"] else "no visible step"
    sentence = (
        f"{log.name}: q_{joint} has {step} and noise of {f['encoder_noise']:.2g}{shown}, "
        f"which leaves {f['velocity_noise']:.2g}{speed} in the velocity below {compute_motion_cutoff(log):.3g} Hz."
    )
    noisy = f["moves"] and f["velocity_noise"] > 0.05 * f["speed"][0]
    doubt = (noisy, f"{sentence} The noise is large for this motion.", "Move faster, or use a finer encoder.")
    return choose_finding("encoder", sentence, doubt)


def _excitation(log: Log, joint: str, f: dict[str, Any], unit: str) -> CheckFinding:
    what = f"{log.name}: joint {joint}"
    if not f["moves"]:
        remedy = "Move it, else its friction and the masses that it alone moves are not identifiable."
        return CheckFinding("warning", "excitation", f"{what} does not move.", remedy)
    share, ratio = f["forward_share"], f["acceleration_rms"] / max(f["acceleration_noise"], 1e-300)
    low, high = f["range"]
    shown, speed = (f" {unit}", f" {unit}/s") if unit else ("", " a second")
    fastest, n_reversals = f"{f['speed'][1]:.3g}{speed}", count(f["n_reversals"], "reversal")
    moved = f"{what}: range {low:.4g} … {high:.4g}{shown}, up to {fastest}, {n_reversals}"
    way, weak = "forwards" if share > 0.5 else "backwards", f"acceleration only {ratio:.2g} times its noise"
    both = "Move both ways, else Coulomb friction and offset are not separable."
    often = f["n_reversals"] >= MIN_REVERSALS
    return choose_finding(
        "excitation",
        f"{moved}, acceleration {ratio:.3g} times its noise.",
        (not 0.02 < share < 0.98, f"{moved}, only {way}.", both),
        (not often, f"{moved}, at least {MIN_REVERSALS} needed.", "Reverse more often, at several speeds."),
        (ratio < 3.0, f"{moved}, {weak}.", "Accelerate harder, else masses are poorly determined."),
    )


def _check_swapped_columns(log: Log) -> dict[str, CheckFinding]:
    """Return a fault for each joint that follows another joint's reference instead of its own."""
    joints = [joint for joint in log.joints("q") if log.has("q_ref", [joint])]
    wanted = {joint: compute_velocities(log, "q_ref", joint) for joint in joints}
    found = {}
    for joint in joints:
        v = compute_velocities(log, "q", joint)
        miss = {other: float(np.sqrt(np.mean((v - r) ** 2))) for other, r in wanted.items()}
        nearest = min(miss, key=miss.__getitem__)
        if miss[nearest] < _CROSSED * miss[joint]:
            sentence = f"{log.name}: q_{joint} follows the reference of {nearest}, not its own."
            found[joint] = CheckFinding("fault", "columns", sentence, "Exchange the columns, or the joints' names.")
    return found


def _lag(log: Log, joint: str, f: dict[str, Any]) -> CheckFinding:
    if f["lag"] is None:
        why = "does not move" if log.has("q_ref", [joint]) else f"has no q_ref_{joint}"
        return CheckFinding("ok", "synchronisation", f"{log.name}: {joint} {why}, so its lag was not tested.")
    sentence = f"{log.name}: q_{joint} lags its reference by {1e3 * f['lag']:.3g} ms."
    early = (f["lag"] < -1.5 * log.dt, f"{sentence} A lag cannot be negative.", "Give both channels the same clock.")
    late = (f["lag"] > 0.1, f"{sentence} The lag is long.", "Check for a delay in one channel.")
    return choose_finding("synchronisation", sentence, early, late)
