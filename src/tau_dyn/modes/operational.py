r"""Operational modal analysis: resonances from responses alone, by covariance-driven stochastic subspace identification.

Under unknown forces that are white over the band of interest, the correlations of the outputs decay as the structure does,

    R_k = E[y_{t+k} y_t'] = C A^{k-1} G,     H = [R_{i+j+1}] = O [G, A G, ...],     O = [C; C A; ...],

so that the left singular vectors of the block-Hankel matrix H give A and C. Modes that agree between the models of most
orders belong to the structure; modes that fit noise change from order to order. Standard errors combine the
delete-one-block jackknife of the correlations, to first order the covariance propagation of Reynders, Pintelon & De
Roeck 2008 and Döhler & Mevel 2013, with the differences between models of other orders. References: Peeters & De Roeck
1999 (SSI-cov); Efron & Stein 1981.

Sensors that are moved between tests make several set-ups, which share outputs that stay in their places (references).
Each set-up gives its own modes. A mode found in all set-ups has the mean of their frequencies and damping ratios, each
weighed by its covariance. The shape phi_s of a set-up is scaled to that of the first by its references, c = phi_s^ref'
phi_1^ref / |phi_s^ref|^2. So the excitation of the set-ups may differ. Reference: Reynders, Magalhães, De Roeck & Cunha
2009 (PoSER merging).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes.modal import FREQUENCY_TOLERANCE, Mode, build_stabilisation_diagram, compute_frequency_and_damping
from tau_dyn.modes.order import read_whole_number
from tau_dyn.modes.record import STEP_TOLERANCE, Record, build_records
from tau_dyn.modes.result import OperationalModes

MAX_HANKEL_ROWS = 240
"""Rows of the block-Hankel matrix: enough for the highest order, and cheap to decompose thirty times."""
MIN_BLOCK_ROWS, MAX_BLOCK_ROWS = 10, 50
MAX_ORDER = 40  # states of the largest model
N_BLOCKS = 30  # blocks of the jackknife: a standard error is then known to 13 %
MIN_BLOCK_PERIODS = 10  # periods of a mode that a block must hold, so that blocks are independent
MIN_MAC = 0.9  # modal assurance criterion above which two shapes are the same
STABLE_SHARE = 0.7  # share of orders, from its first on, in which a mode of the structure appears
MAX_DAMPING = 0.2  # damping ratio above which coloured forces cannot be distinguished from a mode
MAX_FREQUENCY_STDERR = 0.02  # relative standard error above which a frequency is not known
MAX_DAMPING_STDERR = 0.3  # relative standard error above which a damping ratio is hardly known
MAX_SETUP_DIFFERENCE = 0.05  # relative difference of frequencies up to which two set-ups may show the same mode
MAX_SETUP_STDERRS = 4.0  # standard errors up to which the frequencies of two set-ups agree
MIN_REFERENCE = 0.05
"""Size of a shape at the references, relative to its largest output, below which they are at a node."""


def find_operational_modes(
    logs: Log | Sequence[Log], outputs: Sequence[str], *, order: str | int = "auto", seed: int = 0
) -> OperationalModes:
    """Find the modes of a structure that unmeasured forces excite.

    Args:
        logs: Logs; never joined in time. Logs with different outputs are set-ups of one test, whose sensors moved on.
        outputs: Columns that respond; each is in one log at least, and at least one in all.
        order: The highest model order; `auto` takes 40, or less if the data do not suffice.
        seed: Kept with the result; the method is deterministic.

    Raises:
        InputError: A column or an option does not fit.
        CannotAnswer: The logs are too short, or no mode is stable.
    """
    if not outputs:
        raise InputError("bad_option", "no outputs are named; name the columns that respond with --outputs")
    setups = _divide([logs] if isinstance(logs, Log) else list(logs), tuple(outputs))
    found = [_analyse(one, order) for one in setups]
    modes, warnings = found[0].modes, found[0].warnings
    if len(setups) > 1:
        modes, joined = _join([one.modes for one in found], setups, tuple(outputs))
        warnings = (*joined, *dict.fromkeys(w for one in found for w in one.warnings))
    if not modes:
        raise CannotAnswer(
            "not_identifiable",
            "no mode appears at the same place in models of different order, in every set-up",
            "a longer log, under forces that reach all frequencies of interest, without strong tones of machines",
        )
    by_order: dict[int, tuple[Mode, ...]] = {}
    for one in found:
        by_order |= {n: (*by_order.get(n, ()), *some) for n, some in one.by_order.items()}
    return OperationalModes(
        tuple(outputs),
        setups[0].records[0].dt,
        max(by_order),
        modes,
        build_stabilisation_diagram(by_order),
        sum(one.n_samples for one in setups),
        warnings,
        seed,
    )


@dataclass(frozen=True, eq=False)
class _SetUp:
    """Records with the same outputs.

    Attributes:
        records: Unbroken stretches.
        outputs: Its outputs (p,), in the order of the call.
    """

    records: tuple[Record, ...]
    outputs: tuple[str, ...]

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return sum(r.n_samples for r in self.records)

    @property
    def names(self) -> str:
        """Names of its logs."""
        return ", ".join(dict.fromkeys(r.name for r in self.records))


@dataclass(frozen=True, eq=False)
class _Analysis:
    """Modes of a set-up, modes of all orders, and warnings."""

    modes: tuple[Mode, ...]
    by_order: Mapping[int, tuple[Mode, ...]]
    warnings: tuple[str, ...]


def _divide(logs: Sequence[Log], outputs: tuple[str, ...]) -> list[_SetUp]:
    """Return the logs by the outputs that they hold.

    Raises:
        InputError: No log has an output, or no output is in every log.
    """
    held = [tuple(name for name in outputs if name in log.channels) for log in logs]
    if any(not any(name in names for names in held) for name in outputs) or len(logs) == 1:
        held = [outputs for _ in logs]  # `build_records` reports the missing columns
    elif not set.intersection(*map(set, held)):
        listed = "; ".join(f"{log.name} has {', '.join(some) or 'none'}" for log, some in zip(logs, held, strict=True))
        raise InputError(
            "mismatch",
            f"no output is in every log ({listed}); set-ups are joined by a sensor that stays in its place: name its column",
        )
    records: dict[tuple[str, ...], list[Record]] = {}
    for log, names in zip(logs, held, strict=True):
        records.setdefault(names, []).extend(build_records(log, (), names))
    every = [r for some in records.values() for r in some]
    if not all(np.isfinite(r.y).all() for r in every):
        raise InputError("bad_sample", "outputs hold samples that are no numbers; mend them, or cut the log there")
    if any(abs(r.dt / every[0].dt - 1) > STEP_TOLERANCE for r in every):
        raise InputError("time_stamps", "the logs differ in sampling step; resample them to one rate")
    return [_SetUp(tuple(some), names) for names, some in records.items()]


def _analyse(setup: _SetUp, order: str | int) -> _Analysis:
    """Return the modes of a set-up.

    Raises:
        InputError: The order does not fit.
        CannotAnswer: The logs are too short.
    """
    p, n = len(setup.outputs), setup.n_samples
    rows = int(min(np.clip(MAX_HANKEL_ROWS // p, MIN_BLOCK_ROWS, MAX_BLOCK_ROWS), n // (20 * p)))
    if rows < 4:
        raise CannotAnswer(
            "too_little_data",
            f"{n} samples of {p} outputs are too few",
            "a longer log, of some thousand periods of the slowest mode",
        )
    blocks, scale = _correlate_blocks(setup.records, 2 * rows)
    carried = (rows - 1) * p
    asked = read_whole_number("order", order, 2, carried, f"states from 2 to {carried}")
    highest = min(MAX_ORDER, carried) if asked is None else asked
    dt = setup.records[0].dt
    found = _find_modes_by_order(blocks, range(2, highest + 1, 2), dt, scale)
    modes = _select_stable_modes(found)
    return _Analysis(modes, found, _warn(modes, n * dt / len(blocks)))


def _join(
    modes: Sequence[Sequence[Mode]], setups: Sequence[_SetUp], outputs: tuple[str, ...]
) -> tuple[tuple[Mode, ...], tuple[str, ...]]:
    """Return the modes that every set-up shows, over all outputs, and the warnings."""
    fixed = [name for name in outputs if all(name in one.outputs for one in setups)]
    moved = "; ".join(f"{one.names}: {', '.join(n for n in one.outputs if n not in fixed)}" for one in setups)
    said: list[str] = [f"{len(setups)} set-ups are joined by {', '.join(fixed)} ({moved})"]
    joined, alone, differs = [], [], []
    for first in modes[0]:
        same = [first, *(_find_partner(first, modes[0], some) for some in modes[1:])]
        found = [m for m in same if m is not None]
        if len(found) < len(setups):
            alone.append(first)
            continue
        joined.append(_join_mode(found, setups, outputs, fixed))
        spread = [abs(m.frequency_hz - first.frequency_hz) / np.hypot(m.frequency_stderr, first.frequency_stderr)
                  for m in found[1:]]  # fmt: skip
        if max(spread) > MAX_SETUP_STDERRS:
            differs.append(" and ".join(f"{m.frequency_hz:.4g} Hz" for m in found))
    if alone:
        said.append(f"{_names(alone)} of {setups[0].names} is not in every set-up and left out")
    if differs:
        listed = f"one resonance is at {differs[0]} in {'; '.join(one.names for one in setups)}"
        why = "the structure changed between the set-ups, so joined frequencies and shapes are off"
        said.append(CodedWarning("setups_differ", f"{listed}: {why}"))
    nodes = [m for m in joined if max(abs(m.shape[outputs.index(n)]) for n in fixed) < MIN_REFERENCE]
    if nodes:
        said.append(f"{', '.join(fixed)} hardly moves at {_names(nodes)}: joined shapes are rough there")
    return tuple(joined), tuple(said)


def _find_partner(mode: Mode, mine: Sequence[Mode], others: Sequence[Mode]) -> Mode | None:
    """Return the other set-up's mode of the nearest frequency, None if it is far away or nearer to another of `mine`."""

    def nearest(some: Sequence[Mode], f: float) -> Mode | None:
        return min(some, key=lambda m: abs(m.frequency_hz - f), default=None)

    found = nearest(others, mode.frequency_hz)
    if found is None or abs(found.frequency_hz / mode.frequency_hz - 1) > MAX_SETUP_DIFFERENCE:
        return None
    return found if nearest(mine, found.frequency_hz) is mode else None


def _join_mode(found: Sequence[Mode], setups: Sequence[_SetUp], outputs: tuple[str, ...], fixed: Sequence[str]) -> Mode:
    """Return the mean of a mode over set-ups, weighed by covariance, and its shape over all outputs."""
    information, weighed = np.zeros((2, 2)), np.zeros(2)
    sums, count = np.zeros(len(outputs), complex), np.zeros(len(outputs))
    at_first = found[0].shape[[setups[0].outputs.index(name) for name in fixed]]
    for mode, setup in zip(found, setups, strict=True):
        errors = np.array([mode.frequency_stderr, mode.damping_stderr])
        correlation = np.array([[1.0, mode.correlation], [mode.correlation, 1.0]])
        inverse = np.linalg.pinv(correlation * np.outer(errors, errors), hermitian=True, rcond=1e-12)
        information += inverse
        weighed += inverse @ [mode.frequency_hz, mode.damping_ratio]
        here = mode.shape[[setup.outputs.index(name) for name in fixed]]
        places = [outputs.index(name) for name in setup.outputs]
        sums[places] += mode.shape * np.vdot(here, at_first) / np.vdot(here, here)
        count[places] += 1
    cov = np.linalg.pinv(information, hermitian=True, rcond=1e-12)
    (f, zeta), (sf, sz), shape = cov @ weighed, np.sqrt(np.diag(cov)), sums / count
    correlation = float(cov[0, 1] / (sf * sz))
    return Mode(float(f), float(zeta), float(sf), float(sz), shape / shape[np.argmax(np.abs(shape))], correlation)


def _correlate_blocks(records: Sequence[Record], lags: int) -> tuple[np.ndarray, np.ndarray]:
    """Return sums of y_{t+k} y_t', k = 1 .. lags - 1, over blocks of time (B, lags - 1, p, p), and the outputs' scales (p,)."""
    ys = [r.y - r.y.mean(axis=0) for r in records]
    scale = np.sqrt(np.sum([np.sum(y**2, axis=0) for y in ys], axis=0) / sum(len(y) for y in ys))
    total = sum(max(0, len(y) - lags) for y in ys)
    sums = []
    for y in ys:
        scaled, last = y / scale, len(y) - lags
        if last <= lags:
            continue
        for part in np.array_split(np.arange(last), max(1, round(N_BLOCKS * last / total))):
            sums.append([scaled[part + k].T @ scaled[part] for k in range(1, lags)])
    if len(sums) < 4:
        raise CannotAnswer("too_little_data", "the unbroken stretches are too short", "longer stretches without gaps")
    return np.array(sums), scale


@dataclass(frozen=True, eq=False)
class _Subspace:
    """Data for models of all orders: products of the singular vectors without the last or first p rows, and the first p."""

    normal: np.ndarray
    shifted: np.ndarray
    first: np.ndarray

    @classmethod
    def of(cls, R: np.ndarray, highest: int) -> _Subspace:
        """Decompose the block-Hankel matrix of correlations R (lags, p, p)."""
        rows, p = (len(R) + 1) // 2, R.shape[1]
        i = np.arange(rows)
        H = R[i[:, None] + i].transpose(0, 2, 1, 3).reshape(rows * p, rows * p)
        U = np.linalg.svd(H)[0][:, :highest]
        return cls(U[:-p].T @ U[:-p], U[:-p].T @ U[p:], U[:p])

    def dynamics(self, order: int) -> np.ndarray:
        """Return A (n, n)."""
        return np.linalg.solve(self.normal[:order, :order], self.shifted[:order, :order])


def _find_modes_by_order(
    blocks: np.ndarray, orders: Sequence[int], dt: float, scale: np.ndarray
) -> dict[int, tuple[Mode, ...]]:
    """Return the modes of every order with the jackknife's standard errors."""
    total = blocks.sum(axis=0)
    whole = _Subspace.of(total, max(orders))
    others = [_Subspace.of(total - block, max(orders)) for block in blocks]
    found = {}
    for order in orders:
        poles, vectors = np.linalg.eig(whole.dynamics(order))
        parts = [np.linalg.eigvals(other.dynamics(order)) for other in others]
        shapes = (whole.first[:, :order] @ vectors) * scale[:, None]
        modes = [
            _mode(complex(poles[k]), shapes[:, k], parts, dt)
            for k in np.flatnonzero((poles.imag > 1e-6) & (np.abs(poles) < 1))
        ]
        found[order] = tuple(sorted(modes, key=lambda m: m.frequency_hz))
    return found


def _mode(pole: complex, shape: np.ndarray, parts: Sequence[np.ndarray], dt: float) -> Mode:
    """Return the mode of a pole; `parts` are the poles (n,) without each block in turn."""
    f, zeta = compute_frequency_and_damping(pole, dt)
    near = [z[np.argmin(np.abs(z - pole))] for z in parts]
    values = np.array([compute_frequency_and_damping(complex(z), dt) for z in near if z != 0])
    away = values - values.mean(axis=0)
    cov = (len(values) - 1) / len(values) * away.T @ away
    sf, sz = np.sqrt(np.diag(cov))
    correlation = float(cov[0, 1] / max(sf * sz, 1e-300))
    return Mode(float(f), float(zeta), float(sf), float(sz), shape / shape[np.argmax(np.abs(shape))], correlation)


def _select_stable_modes(found: dict[int, tuple[Mode, ...]]) -> tuple[Mode, ...]:
    """Return the modes that most orders hold: each order adds at most one mode to a chain, the nearest in frequency."""
    chains: list[list[tuple[int, Mode]]] = []
    for order in sorted(found):
        modes = [m for m in found[order] if _known(m)]
        pairs = [
            (abs(m.frequency_hz / _median(chain)[0] - 1), i, j)
            for i, chain in enumerate(chains)
            for j, m in enumerate(modes)
            if _same(chain[-1][1], m)
        ]
        taken: dict[int, int] = {}
        for _, i, j in sorted(pairs):
            if i not in taken and j not in taken.values():
                taken[i] = j
                chains[i].append((order, modes[j]))
        chains += [[(order, m)] for j, m in enumerate(modes) if j not in taken.values()]
    kept: list[Mode] = []
    for chain in sorted(chains, key=len, reverse=True):
        after = [o for o in found if o >= chain[0][0]]
        mode = _take(chain)
        if len(chain) >= max(3, STABLE_SHARE * len(after)) and not any(_same(other, mode) for other in kept):
            kept.append(mode)
    return tuple(sorted(kept, key=lambda m: m.frequency_hz))


def _known(mode: Mode) -> bool:
    """Return whether a mode is damped like one of a structure and its frequency is known."""
    return mode.damping_ratio < MAX_DAMPING and mode.frequency_stderr < MAX_FREQUENCY_STDERR * mode.frequency_hz


def _median(chain: Sequence[tuple[int, Mode]]) -> np.ndarray:
    """Return medians over orders of frequency, damping and their standard errors (4,)."""
    rows = [(m.frequency_hz, m.damping_ratio, m.frequency_stderr, m.damping_stderr) for _, m in chain]
    return np.median(rows, axis=0)


def _take(chain: Sequence[tuple[int, Mode]]) -> Mode:
    """Return a mode as the lowest order has it that agrees with the median of all orders within a standard error.

    Spare states add scatter, too few states bias. No order is known to be right, so the mean square difference of the other
    orders from the one taken adds to the jackknife's variance.
    """
    f, z, sf, sz = _median(chain)

    def away(m: Mode) -> float:
        return max(abs(m.frequency_hz - f) / sf, abs(m.damping_ratio - z) / sz, m.damping_stderr / sz - 1)

    modes = [m for _, m in chain]
    taken = next((m for m in modes if away(m) <= 1), min(modes, key=away))
    own = np.array([taken.frequency_stderr, taken.damping_stderr])
    apart = np.array([(m.frequency_hz - taken.frequency_hz, m.damping_ratio - taken.damping_ratio) for m in modes])
    wide = np.sqrt(own**2 + np.mean(apart**2, axis=0))
    kept = taken.correlation * float(own.prod() / max(wide.prod(), 1e-300))
    return replace(taken, frequency_stderr=float(wide[0]), damping_stderr=float(wide[1]), correlation=kept)


def _same(a: Mode, b: Mode) -> bool:
    """Return whether two orders hold the same mode: frequency and shape (van der Auweraer & Peeters 2004)."""
    if abs(a.frequency_hz - b.frequency_hz) > FREQUENCY_TOLERANCE * a.frequency_hz:
        return False
    inner = abs(np.vdot(a.shape, b.shape)) ** 2
    return bool(inner > MIN_MAC * np.vdot(a.shape, a.shape).real * np.vdot(b.shape, b.shape).real)


def _warn(modes: Sequence[Mode], block_seconds: float) -> tuple[str, ...]:
    """Return the warnings about the modes."""
    said: list[str] = []
    slow = [m for m in modes if m.frequency_hz * block_seconds < MIN_BLOCK_PERIODS]
    if slow:
        few = f"the log holds fewer than {MIN_BLOCK_PERIODS * N_BLOCKS} periods of {_names(slow)}: its errors are rough"
        said.append(CodedWarning("short_log", few))
    tones = [m for m in modes if m.damping_ratio < 2 * m.damping_stderr]
    if tones:
        said.append(f"the damping at {_names(tones)} may be zero: a tone of a machine looks the same")
    vague = [m for m in modes if m not in tones and m.damping_stderr > MAX_DAMPING_STDERR * m.damping_ratio]
    if vague:
        said.append(f"the damping at {_names(vague)} is known to worse than 30 %")
    return tuple(said)


def _names(modes: Sequence[Mode]) -> str:
    return ", ".join(f"{m.frequency_hz:.3g} Hz" for m in modes)
