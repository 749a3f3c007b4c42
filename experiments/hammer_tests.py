"""Hammer tests as workshops make them, with a known truth: are resonances, mass and stiffness right by default options?

    python experiments/hammer_tests.py [--sets 60] [--seed 0] [--only NUMBER...] [--out FILE.csv]

In: nothing; chains of two to six masses between springs, each hit three or four times at one, two or all places, a column for
each place. The force is linear between samples, its channel has noise of 1/300 of its peak; accelerometers are in g with noise of
0.2 % of their peak. In every third set they roll off by a filter of second order at a third of the sampling rate; in every second
one a blow hits twice. Out: a row a set with the largest errors of frequency, damping, M and K, modes that are not there, the
shares of 95 % intervals that hold the truth and seconds of CPU; and the counts.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.signal import butter, cont2discrete, dlsim

from tau_dyn.exceptions import TauDynError
from tau_dyn.files import write_whole
from tau_dyn.log import Log
from tau_dyn.modes import Modes, find_modes

FORCE_NOISE = 1 / 300
SENSOR_NOISE = 2e-3
G = 9.80665


@dataclass(frozen=True, eq=False)
class HammerTest:
    """A structure and how it is hit: M, D, K in SI, places that are hit, what else is real about it."""

    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    places: tuple[int, ...]
    rate: float
    rolls_off: bool
    hits_twice: bool

    @property
    def poles(self) -> np.ndarray:
        """One pole of each mode, slowest first [rad/s]."""
        values = np.linalg.eigvals(self.matrices[0])
        values = values[values.imag > 0]
        return values[np.argsort(np.abs(values))]

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A, B, C, D from forces to accelerations."""
        n, force = len(self.M), np.linalg.inv(self.M)[:, list(self.places)]
        A = np.block(
            [[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(self.M, self.K), -np.linalg.solve(self.M, self.D)]]
        )
        return A, np.vstack([np.zeros_like(force), force]), A[n:], force

    def respond(self, force: np.ndarray) -> np.ndarray:
        """Return accelerations (N, n) under a force (N, m) that is linear between samples, after the sensors' filter."""
        A, B, C, D = self.matrices
        if self.rolls_off:
            n, (num, den) = len(self.M), butter(2, 2 * np.pi * self.rate / 3, analog=True)
            f = np.array([[0.0, 1.0], [-den[2], -den[1]]])
            into, out = np.kron(np.eye(n), [[0.0], [1.0]]), np.kron(np.eye(n), [[num[-1], 0.0]])
            A = np.block([[A, np.zeros((2 * n, 2 * n))], [into @ C, np.kron(np.eye(n), f)]])
            B, C, D = np.vstack([B, into @ D]), np.hstack([np.zeros((n, 2 * n)), out]), np.zeros_like(D)
        step = cont2discrete((A, B, C, D), 1 / self.rate, method="foh")
        return dlsim(step, force)[1]


def draw_test(number: int, rng: np.random.Generator) -> HammerTest:
    """Return a set's structure: two to six masses in a chain, damping of 0.5 to 4 %."""
    n = 2 + number % 5
    while True:
        M, springs = np.diag(rng.uniform(2, 15, n)), rng.uniform(0.5, 2.0, n + 1) * 10 ** rng.uniform(5.3, 6.3)
        K = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
        w = np.sqrt(np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real))
        if np.all(np.diff(w) > 0.06 * w[:-1]):  # two modes in one peak are another test
            break
    low, high = rng.uniform(0.005, 0.02), rng.uniform(0.01, 0.03)
    a, b = np.linalg.solve([[1 / (2 * w[0]), w[0] / 2], [1 / (2 * w[-1]), w[-1] / 2]], [low, high])
    D = max(a, 0.0) * M + max(b, 0.0) * K
    places = [(int(rng.integers(n)),), tuple(rng.choice(n, 2, replace=False).tolist()), tuple(range(n))][number % 3]
    rate = float(2 ** np.ceil(np.log2(10 * w[-1] / (2 * np.pi))))
    return HammerTest(M, D, K, tuple(sorted(places)), rate, number % 3 == 1, number % 2 == 1)


def record(test: HammerTest, rng: np.random.Generator) -> Log:
    """Return the log of one session of blows."""
    decay = np.abs(test.poles.real).min()
    between, hits = round(test.rate * (4.5 / decay + 0.1)), 3 + int(rng.integers(2))
    n, m = between * hits * len(test.places) + round(0.2 * test.rate), len(test.places)
    force, peak = np.zeros((n, m)), rng.uniform(80, 250)
    width = max(4, round(test.rate * rng.uniform(0.5, 1.2) * np.pi / np.abs(test.poles[-1])))
    for k in range(hits * m):
        start = round(0.1 * test.rate) + k * between + int(rng.integers(10))
        shape = peak * rng.uniform(0.7, 1.3) * np.sin(np.pi * np.arange(width + 1) / width)
        force[start : start + width + 1, k % m] += shape
        if test.hits_twice and k == 1:
            again = start + width + round(test.rate * 0.012)
            force[again : again + width + 1, k % m] += 0.3 * shape
    y = test.respond(force) / G
    y = y + SENSOR_NOISE * np.abs(y).max() * rng.standard_normal(y.shape)
    force = force + FORCE_NOISE * peak * rng.standard_normal(force.shape)
    named = {f"f{p + 1}": force[:, k] for k, p in enumerate(test.places)} | {
        f"acc{k + 1}_g": y[:, k] for k in range(y.shape[1])
    }
    return Log(np.arange(n) / test.rate, named, name="hammer")


def judge(test: HammerTest, found: Modes) -> dict[str, object]:
    """Return the largest errors, modes that are not there or are missing, and intervals that hold the truth."""
    truth, left = test.poles, list(found.modes)
    frequency, damping, inside, missing = [], [], [], 0
    for pole in truth:
        hz, ratio = abs(pole) / (2 * np.pi), -pole.real / abs(pole)
        mode = min(left, key=lambda m: abs(m.frequency_hz - hz), default=None)
        if mode is None or abs(mode.frequency_hz / hz - 1) > 0.02:
            missing += 1
            continue
        left.remove(mode)
        frequency.append(abs(mode.frequency_hz / hz - 1))
        damping.append(abs(mode.damping_ratio / ratio - 1))
        inside += [abs(mode.frequency_hz - hz) < 1.96 * mode.frequency_stderr]
        inside += [abs(mode.damping_ratio - ratio) < 1.96 * mode.damping_stderr]
    m = found.mechanical
    row = {
        "frequency_percent": 100 * max(frequency, default=np.nan),
        "damping_percent": 100 * max(damping, default=np.nan),
        "phantom": len(left),
        "missing": missing,
        "inside": sum(inside),
        "intervals": len(inside),
        "status": "" if m is None else m.status,
        "hold": "" if m is None else m.hold,
        "why": found.mechanical_why if m is None else m.why,
    }
    if m is not None and m.status == "identified" and m.M is not None and m.K is not None and m.stderr is not None:
        pairs = ((m.M, m.stderr.M, test.M), (m.K, m.stderr.K, test.K))
        row["mass_percent"], row["stiffness_percent"] = (
            100 * np.linalg.norm(a - b, 2) / np.linalg.norm(b, 2) for a, _, b in pairs
        )
        held = [np.abs(a - b) < 1.96 * s for a, s, b in pairs]
        upper = np.triu_indices(len(test.M))
        row["entries_inside"], row["entries"] = int(sum(x[upper].sum() for x in held)), 2 * len(upper[0])
    return row


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="+")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows = []
    for number in asked.only or range(asked.sets):
        rng = np.random.default_rng([asked.seed, number])
        test = draw_test(number, rng)
        log = record(test, rng)
        inputs = [f"f{p + 1}" for p in test.places]
        pairs = [(f"f{p + 1}", f"acc{p + 1}_g") for p in test.places]
        row = {
            "number": number,
            "masses": len(test.M),
            "places": len(test.places),
            "samples": log.n_samples,
            "rolls_off": test.rolls_off,
        }
        start = time.process_time()
        try:
            found = find_modes(log, inputs, [f"acc{k + 1}_g" for k in range(len(test.M))], collocated=pairs)
            row |= {"order": found.order, **judge(test, found)}
        except TauDynError as fault:
            row["fault"] = str(fault)
        row["cpu_s"] = round(time.process_time() - start, 1)
        rows.append(row)
        print(*(f"{v:.4g}" if isinstance(v, float) else v for v in row.values()), flush=True)
        if asked.out is not None:
            write_whole(asked.out, pd.DataFrame(rows).to_csv(index=False))
    table = pd.DataFrame(rows)
    known = table[table["status"] == "identified"] if "status" in table else table[:0]
    print(
        f"{len(table)} sets: {int((table.frequency_percent < 0.1).sum())} with all frequencies within 0.1 %, "
        f"{int((table.damping_percent < 5).sum())} with all damping within 5 %, {int((table.phantom > 0).sum())} with a mode "
        f"that is not there, {int((table.missing > 0).sum())} without one that is; coverage "
        f"{100 * table.inside.sum() / table.intervals.sum():.1f} %; M, D, K identified in {len(known)}"
        + (
            f", M and K within 3 % in {int(((known.mass_percent < 3) & (known.stiffness_percent < 3)).sum())}, coverage "
            f"{100 * known.entries_inside.sum() / known.entries.sum():.1f} %"
            if len(known)
            else ""
        )
        + f"; CPU {table.cpu_s.median():.1f} s (median), {table.cpu_s.max():.1f} s (most)"
    )


if __name__ == "__main__":
    main()
