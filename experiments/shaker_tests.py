"""Ordinary shaker tests with a known truth: does the default answer, and do its intervals hold it?

    python experiments/shaker_tests.py [--tests three fourteen weak strong] [--seeds 0 1 2] [--methods auto n4sid pbsid]
    python experiments/shaker_tests.py --feedback [--outputs 1 3 10 28] [--gains 0 0.3 1] --runs 20 --first-seed 1000
    python experiments/shaker_tests.py --acausality [--gains 0.3 1 3] --runs 60 --first-seed 1000

A structure of separate modes is driven by a continuous random force that ends below the Nyquist frequency. Force and
responses pass the same anti-alias filters before they are sampled, so the samples hold no power near the Nyquist frequency
and the sampled path looks slightly acausal. `weak` and `strong` close a loop on the velocity (largest loop gains 0.3 and
0.8) under a disturbing force; the loop's reference is not logged. Out: one line a test and method.

`--feedback` asks only whether a loop is claimed: three modes, 6000 samples, models of order 8 without refinement. Loops have
1 % of noise and a disturbing force of half the force's size; so have open loops (gain 0) of even seeds, those of odd seeds
have no disturbance, and 1 or 0.1 % of noise. Out: how many sets are claimed by the decision and by each of the two tests
alone, and in how many standard errors allow for a loop.

`--acausality` asks how often the acausality test alone is wrong on eight kinds of open loops, at 1 % and 5 %, and how often it
claims loops with 1 % of noise and a disturbing force, in 6 and 60 seconds of which 70 % are used.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, lfilter, sosfilt
from scipy.stats import binomtest

from tau_dyn.exceptions import TauDynError
from tau_dyn.log import Log
from tau_dyn.modes import StateSpace, find_modes
from tau_dyn.modes.delay import DelayChoice
from tau_dyn.modes.feedback_tests import ACAUSALITY_SIGNIFICANCE_LEVEL, Acausality, detect_feedback, find_acausality
from tau_dyn.modes.find import MethodCandidate, check_candidate, settle
from tau_dyn.modes.methods import build_initial_estimator
from tau_dyn.modes.order import OrderChoice, OrderTrial, select_parts
from tau_dyn.modes.record import prepare_records
from tau_dyn.modes.residuals import compute_residuals

RATE_HZ, OVERSAMPLING = 1000, 16
"""Sampling rate of the log; the continuous world is computed 16 times finer."""
FOURTEEN = (22.0, 37, 55, 71, 88, 112, 137, 160, 181, 207, 233, 262, 296, 331)


@dataclass(frozen=True)
class Shaker:
    """A test: modes [Hz] and their damping, outputs, loop gain, samples, share of noise."""

    hz: tuple[float, ...] = (60.0, 150.0, 280.0)
    damping: float = 0.01
    outputs: int = 1
    gain: float = 0.0
    disturbance: float = 0.0
    n: int = 8000
    noise: float = 1e-3
    band_hz: float = 400.0


TESTS = {
    "three": Shaker(),
    "three_short": Shaker(n=3000),
    "three_noisy": Shaker(noise=0.03),
    "fourteen": Shaker(hz=FOURTEEN, outputs=2, n=12000),
    "twenty_eight": Shaker(hz=FOURTEEN[:6], outputs=28, n=6000, noise=0.01),
    "weak": Shaker(gain=0.3, disturbance=0.5, n=8000),
    "strong": Shaker(gain=0.8, disturbance=0.5, n=8000),
}
OPEN_LOOPS = {
    "quiet": (Shaker(n=6000, noise=0.01), 8),
    "disturbed": (Shaker(n=6000, noise=0.01, disturbance=0.5), 8),
    "three outputs": (Shaker(n=6000, outputs=3, noise=0.01, disturbance=0.5), 8),
    "too low an order": (Shaker(n=6000, noise=0.01, disturbance=0.5), 4),
    "short": (Shaker(n=2000, noise=0.01, disturbance=0.5), 8),
    "narrow band": (Shaker(hz=(40.0, 90, 150), n=6000, noise=0.01, disturbance=0.5, band_hz=200.0), 8),
    "light damping": (Shaker(damping=0.003, n=6000, noise=0.01, disturbance=0.5), 8),
    "fourteen modes": (Shaker(hz=FOURTEEN, outputs=2, n=12000), 28),
}
"""Tests without a loop, and the order of the model that is taken."""


def record_shaker(test: Shaker, seed: int = 0) -> Log:
    """Return the log of a test, columns `force` and `place1`, `place2`, ..."""
    rng = np.random.default_rng(seed)
    dt, n = 1 / (RATE_HZ * OVERSAMPLING), test.n * OVERSAMPLING
    settle = RATE_HZ * OVERSAMPLING  # a second before the log begins
    alias = butter(6, test.band_hz, fs=1 / dt, output="sos")
    white = rng.normal(size=(n + settle, 2))
    asked = sosfilt(butter(4, test.band_hz, fs=1 / dt, output="sos"), white[:, 0])
    asked /= asked.std()
    disturbing = lfilter([1], [1, -np.exp(-2 * np.pi * 100 * dt)], white[:, 1])
    disturbing *= test.disturbance / disturbing.std()
    shapes = np.random.default_rng(5).uniform(0.4, 1.0, (test.outputs, len(test.hz)))
    shapes *= np.random.default_rng(6).choice([-1.0, 1.0], shapes.shape)
    if test.gain == 0:
        force = asked
        total = force + disturbing
        y = _driven(test, total, dt) @ shapes.T
    else:
        force, y = _in_loop(test, asked, disturbing, dt)
        y = y @ shapes.T
    seen = sosfilt(alias, np.column_stack([force, y]), axis=0)[settle::OVERSAMPLING][: test.n]
    seen = seen + test.noise * seen.std(axis=0) * rng.normal(size=seen.shape)
    names = ["force", *(f"place{k + 1}" for k in range(test.outputs))]
    return Log(np.arange(test.n) / RATE_HZ, dict(zip(names, seen.T, strict=True)), "shaker.csv")


def _poles(test: Shaker, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return damped poles, and the numerators of displacement and velocity per unit force, of sampled modes."""
    w = 2 * np.pi * np.array(test.hz)
    s = -test.damping * w + 1j * w * np.sqrt(1 - test.damping**2)
    return np.exp(s * dt), s, w


def _driven(test: Shaker, force: np.ndarray, dt: float) -> np.ndarray:
    """Return modal accelerations-scaled displacements (N, modes), each of about unit size."""
    z, s, w = _poles(test, dt)
    out = [
        np.imag(lfilter([0, 1], [1, -pole], force.astype(complex)) * w_k * dt) for pole, w_k in zip(z, w, strict=True)
    ]
    return np.column_stack(out)


def _in_loop(test: Shaker, asked: np.ndarray, disturbing: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return force and modal displacements under force = asked - k * (sum of modal velocities)."""
    z, s, w = _poles(test, dt)
    # velocity of a mode is Re(x) in the coordinates whose Im is the displacement; its peak gain is about 1 / (2 zeta)
    k = test.gain * 2 * test.damping
    A = np.kron(np.diag(z.real), np.eye(2)) + np.kron(np.diag(z.imag), [[0.0, -1.0], [1.0, 0.0]])
    B, velocities = np.kron(w * dt, [1.0, 0.0]), np.tile([1.0, 0.0], len(z))
    values, vectors = np.linalg.eig(A - k * np.outer(B, velocities))
    excited = np.linalg.solve(vectors, B.astype(complex))
    x = np.zeros((len(asked), len(values)))
    for pole, gain, vector in zip(values, excited, vectors.T, strict=True):
        x += np.real(np.outer(lfilter([0, gain], [1, -pole], (asked + disturbing).astype(complex)), vector))
    force, y = asked - k * (x @ velocities), x[:, 1::2]
    return force, y


def judge(test: Shaker, log: Log, method: str, **options) -> dict:
    """Return what the tool finds and how it compares with the truth."""
    start = time.perf_counter()
    row: dict = {"method": method}
    try:
        found = find_modes(log, ["force"], [c for c in log.channels if c != "force"], method=method, **options)
    except TauDynError as fault:
        return row | {"failed": str(fault), "seconds": time.perf_counter() - start}
    row |= {"took": found.method, "order": found.order, "delay": found.delay, "feedback": found.feedback.suspected}
    row |= {"p": found.feedback.p_value, "holdout": found.judged.mean, "seconds": time.perf_counter() - start}
    held, errors, sizes = 0, [], []
    for f in test.hz:
        near = [m for m in found.modes if abs(m.frequency_hz / f - 1) < 0.03]
        if not near:
            continue
        mode = min(near, key=lambda m: abs(m.frequency_hz - f))
        held += abs(mode.damping_ratio - test.damping) < 1.96 * mode.damping_stderr
        errors.append(abs(mode.damping_ratio / test.damping - 1))
        sizes.append(mode.damping_stderr / test.damping)
    row |= {"modes": f"{len(errors)}/{len(test.hz)}", "extra": len(found.modes) - len(errors), "held": held}
    return row | {"damping_error_%": 100 * max(errors, default=np.nan), "stderr_%": 100 * max(sizes, default=np.nan)}


def decide_feedback(outputs: int, gain: float, seed: int) -> dict[str, bool]:
    """Return whether a loop is claimed, by the decision and by each test alone."""
    disturbance, noise = 0.5 if gain or seed % 2 == 0 else 0.0, 1e-3 if gain == 0 and seed % 4 == 3 else 0.01
    test = Shaker(outputs=outputs, gain=gain, disturbance=disturbance, n=6000, noise=noise)
    data = prepare_records([record_shaker(test, seed)], ["force"], [f"place{k + 1}" for k in range(outputs)])

    def make(method: str) -> MethodCandidate:
        model = build_initial_estimator(method, select_parts(data.train)[0])(8)
        states = OrderChoice(8, (_trial_of(model),), {}, "")
        return MethodCandidate(method, "output_error", DelayChoice(0, (), float("nan"), ""), states)

    plain, before = make("n4sid"), detect_feedback(data.train)
    _, feedback, _ = settle(data, before, plain, lambda: make("pbsid"))
    alone = check_candidate(plain, data).p_value < ACAUSALITY_SIGNIFICANCE_LEVEL
    row = {"claimed": feedback.suspected, "acausality": alone, "innovations": before.suspected}
    return row | {"allowed for": feedback.suspected or feedback.possible}


def measure_acausality(test: Shaker, order: int, seed: int) -> Acausality:
    """Return what the acausality test says of a test under a first model."""
    data = prepare_records([record_shaker(test, seed)], ["force"], [f"place{k + 1}" for k in range(test.outputs)])
    model = build_initial_estimator("n4sid", select_parts(data.train)[0])(order)
    return find_acausality(compute_residuals(model, data.train), [r.u for r in data.train], model)


def print_acausality(gains: list[float], runs: int, first: int) -> None:
    """Print false-alarm rates with exact binomial 95 % intervals, then how often loops are claimed, and the stated limit."""
    everything: list[float] = []
    for kind, (test, order) in OPEN_LOOPS.items():
        p = [measure_acausality(test, order, first + len(everything) + k).p_value for k in range(runs)]
        everything += p
        print(f"{kind}: {_count_below(p, 0.01)}, {_count_below(p, 0.05)}", flush=True)
    print(f"all: {_count_below(everything, 0.01)}, {_count_below(everything, 0.05)}", flush=True)
    for n in (6000, 60000):
        for gain in gains:
            test = Shaker(n=n, noise=0.01, disturbance=0.5, gain=gain)
            found = [measure_acausality(test, 8, first + k) for k in range(max(1, runs // 3))]
            limit = np.median([row.detectable_gain for row in found])
            words = ", ".join(_count_below([row.p_value for row in found], level) for level in (1e-3, 0.01, 0.05))
            print(f"{n // RATE_HZ} s, loop gain {gain:g}: {words}; detection limit {limit:.2g}", flush=True)


def _count_below(p: list[float], level: float) -> str:
    count = sum(value < level for value in p)
    low, high = binomtest(count, len(p)).proportion_ci(method="exact")
    return f"{count} of {len(p)} below {100 * level:g} % ({100 * low:.1f} to {100 * high:.1f} %)"


def _trial_of(model: StateSpace) -> OrderTrial:
    """Return a first model as the trial of its order."""
    nan = float("nan")
    return OrderTrial(model.order, nan, nan, nan, nan, 0.0, True, False, (), model)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tests", nargs="+", default=["three", "fourteen", "weak", "strong"], choices=sorted(TESTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--methods", nargs="+", default=["auto"])
    parser.add_argument("--order", default="auto")
    parser.add_argument("--feedback", action="store_true")
    parser.add_argument("--acausality", action="store_true")
    parser.add_argument("--outputs", nargs="+", type=int, default=[1, 3, 10, 28])
    parser.add_argument("--gains", nargs="+", type=float, default=[0.0, 0.3, 1.0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1000)
    args = parser.parse_args()
    if args.acausality:
        return print_acausality(args.gains, args.runs, args.first_seed)
    if args.feedback:
        for outputs in args.outputs:
            for gain in args.gains:
                rows = [decide_feedback(outputs, gain, args.first_seed + k) for k in range(args.runs)]
                counts = (f"{name} {sum(row[name] for row in rows)}" for name in rows[0])
                print(f"outputs {outputs} gain {gain:g} of {args.runs}:", ", ".join(counts), flush=True)
        return
    for name in args.tests:
        for seed in args.seeds:
            log = record_shaker(TESTS[name], seed)
            for method in args.methods:
                row = judge(TESTS[name], log, method, order=args.order)
                words = (f"{k}={v:.3g}" if isinstance(v, float) else f"{k}={v}" for k, v in row.items())
                print(f"{name} seed {seed}:", " ".join(words), flush=True)


if __name__ == "__main__":
    main()
