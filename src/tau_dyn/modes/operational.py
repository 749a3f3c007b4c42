r"""Operational modal analysis: resonances from responses alone, by covariance-driven stochastic subspace identification.

Under unknown forces that are white over the band of interest, the correlations of the outputs decay as the structure does,

    R_k = E[y_{t+k} y_t'] = C A^{k-1} G,     H = [R_{i+j+1}] = O [G, A G, ...],     O = [C; C A; ...],

so that the left singular vectors of the block-Hankel matrix H give A and C. Modes at the same place in the models of most
orders belong to the structure; what noise makes of spare states wanders. Standard errors are those of the delete-one-block
jackknife of the correlations, to first order the covariance propagation of Reynders, Pintelon & De Roeck 2008 and Döhler &
Mevel 2013. References: Peeters & De Roeck 1999 (SSI-cov); Efron & Stein 1981.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log
from tau_dyn.message_codes import CodedWarning
from tau_dyn.modes.modal import FREQUENCY_TOLERANCE, Mode, build_stabilisation_diagram, compute_frequency_and_damping
from tau_dyn.modes.order import read_whole_number
from tau_dyn.modes.record import Record, build_records
from tau_dyn.modes.result import OperationalModes

MAX_HANKEL_ROWS = 240
"""Rows of the block-Hankel matrix: enough for the highest order, and cheap to decompose thirty times."""
MIN_BLOCK_ROWS, MAX_BLOCK_ROWS = 10, 50
MAX_ORDER = 40  # states of the largest model
N_BLOCKS = 30  # blocks of the jackknife: a standard error is then known to 13 %
MIN_BLOCK_PERIODS = 10  # periods of a mode that a block must hold, so that blocks are independent
MIN_MAC = 0.9  # modal assurance criterion above which two shapes are the same
STABLE_SHARE = 0.7  # share of orders, from its first on, in which a mode of the structure appears
MAX_DAMPING = 0.2  # damping ratio above which forces that are not white cannot be told from a mode
MAX_FREQUENCY_STDERR = 0.02  # relative standard error above which a frequency is not known
MAX_DAMPING_STDERR = 0.3  # relative standard error above which a damping ratio is hardly known


def find_operational_modes(
    logs: Log | Sequence[Log], outputs: Sequence[str], *, order: str | int = "auto", seed: int = 0
) -> OperationalModes:
    """Find the modes of a structure that unmeasured forces excite.

    Args:
        logs: Logs; never joined.
        outputs: Columns that respond.
        order: The highest order of model; `auto` takes 40, or what the data carry.
        seed: Kept with the result; nothing here is random.

    Raises:
        InputError: A column or an option does not fit.
        CannotAnswer: The logs are too short, or no mode is stable.
    """
    if not outputs:
        raise InputError("bad_option", "no outputs are named; name the columns that respond with --outputs")
    several = [logs] if isinstance(logs, Log) else list(logs)
    records = [r for log in several for r in build_records(log, (), tuple(outputs))]
    if not all(np.isfinite(r.y).all() for r in records):
        raise InputError("bad_sample", "outputs hold samples that are no numbers; mend them, or cut the log there")
    p, n = len(outputs), sum(r.n_samples for r in records)
    rows = int(min(np.clip(MAX_HANKEL_ROWS // p, MIN_BLOCK_ROWS, MAX_BLOCK_ROWS), n // (20 * p)))
    if rows < 4:
        raise CannotAnswer(
            "too_little_data",
            f"{n} samples of {p} outputs are too few",
            "a longer log, of some thousand periods of the slowest mode",
        )
    blocks, scale = _correlate_blocks(records, 2 * rows)
    carried = (rows - 1) * p
    asked = read_whole_number("order", order, 2, carried, f"states from 2 to {carried}")
    highest = min(MAX_ORDER, carried) if asked is None else asked
    found = _find_modes_by_order(blocks, range(2, highest + 1, 2), records[0].dt, scale)
    modes = _select_stable_modes(found)
    if not modes:
        raise CannotAnswer(
            "not_identifiable",
            "no mode appears at the same place in models of different order",
            "a longer log, under forces that reach all frequencies of interest, without strong tones of machines",
        )
    warnings = _warn(modes, n * records[0].dt / len(blocks))
    diagram = build_stabilisation_diagram(found)
    return OperationalModes(tuple(outputs), records[0].dt, highest, modes, diagram, n, warnings, seed)


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
    """What models of all orders need: products of the singular vectors without their last or first p rows, and the first p."""

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
    """Tell whether a mode is damped like one of a structure, and its frequency known."""
    return mode.damping_ratio < MAX_DAMPING and mode.frequency_stderr < MAX_FREQUENCY_STDERR * mode.frequency_hz


def _median(chain: Sequence[tuple[int, Mode]]) -> np.ndarray:
    """Return medians over orders of frequency, damping and their standard errors (4,)."""
    rows = [(m.frequency_hz, m.damping_ratio, m.frequency_stderr, m.damping_stderr) for _, m in chain]
    return np.median(rows, axis=0)


def _take(chain: Sequence[tuple[int, Mode]]) -> Mode:
    """Return a mode as the lowest order has it that agrees with the median of all orders within a standard error.

    Spare states add scatter, too few states bias.
    """
    f, z, sf, sz = _median(chain)

    def away(m: Mode) -> float:
        return max(abs(m.frequency_hz - f) / sf, abs(m.damping_ratio - z) / sz, m.damping_stderr / sz - 1)

    modes = [m for _, m in chain]
    return next((m for m in modes if away(m) <= 1), min(modes, key=away))


def _same(a: Mode, b: Mode) -> bool:
    """Tell whether two orders hold the same mode: frequency and shape (van der Auweraer & Peeters 2004)."""
    if abs(a.frequency_hz - b.frequency_hz) > FREQUENCY_TOLERANCE * a.frequency_hz:
        return False
    inner = abs(np.vdot(a.shape, b.shape)) ** 2
    return bool(inner > MIN_MAC * np.vdot(a.shape, a.shape).real * np.vdot(b.shape, b.shape).real)


def _warn(modes: Sequence[Mode], block_seconds: float) -> tuple[str, ...]:
    """Return what is doubtful about the modes."""
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
