"""Rates of operational modal analysis and of the test of nonlinearity, on simulated sets with a known truth.

    python experiments/operational_modes.py [--runs 30] [--seed 0] [--samples 20000 80000] [--only ambient nonlinear]

Ambient: three modes drawn for each run (2 to 25 Hz, damping 0.5 to 3 %) under unmeasured white forces at three places, three
outputs at 100 Hz with 5 % of noise. Out: modes found, false modes, bias, scatter and coverage of 95 % intervals.

Nonlinear: 3000 samples at 50 Hz of two modes (3 and 7 Hz, 3 %) with noise and a disturbance, in open loop and under velocity
feedback, the input Gaussian or binary, by the default identification; then the same with a spring that is stiffer by 3, 10 and
30 % at the response's root mean square, by n4sid at order 4. Out: how often `response_nonlinear` warns.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.signal import lfilter

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import Log
from tau_dyn.modes import find_modes, find_operational_modes

RATE_HZ = 100.0
OUTPUTS = ["y1", "y2", "y3"]
SHAPES = np.array([[0.4, 1.0, 0.9], [0.8, 0.5, -1.0], [1.0, -0.8, 0.5]])
FORCES = np.array([[1, 0.3, 0.5], [0.2, 1, -0.4], [0.6, -0.5, 1]])
DT, STEPS = 0.02, 8
"""Sampling step [s] of the nonlinear sets, and integration steps within it."""
STIFFENING = (0.0, 0.03, 0.1, 0.3)


def draw_modes(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [Hz] and damping ratios of three modes at least 20 % apart."""
    rng = np.random.default_rng([seed, 1])
    while True:
        hz = np.sort(np.exp(rng.uniform(np.log(2.0), np.log(25.0), 3)))
        if (hz[1:] / hz[:-1]).min() > 1.2:
            return hz, np.exp(rng.uniform(np.log(0.005), np.log(0.03), 3))


def record_ambient(n: int, seed: int, hz: np.ndarray, damping: np.ndarray, noise: float = 0.05) -> Log:
    """Return a log of outputs `y1`, `y2`, `y3` under white forces that are not logged."""
    rng = np.random.default_rng(seed)
    w = 2 * np.pi * hz
    poles = np.exp((-damping * w + 1j * w * np.sqrt(1 - damping**2)) / RATE_HZ)
    forces = rng.normal(size=(n + 3000, 3)) @ FORCES
    modal = [np.imag(lfilter([0, 1], [1, -z], f.astype(complex))) for z, f in zip(poles, forces.T, strict=True)]
    y = (np.column_stack(modal) / np.std(modal, axis=1) @ SHAPES)[3000:]
    y += noise * y.std(axis=0) * rng.normal(size=y.shape)
    return Log(np.arange(n) / RATE_HZ, dict(zip(OUTPUTS, y.T, strict=True)), "ambient.csv")


def study_ambient(runs: int, seed: int, samples: int) -> None:
    """Print the rates of operational modal analysis."""
    found, false, errors, spread = 0, 0, [], []
    for run in range(seed, seed + runs):
        hz, damping = draw_modes(run)
        try:
            modes = find_operational_modes(record_ambient(samples, run, hz, damping), OUTPUTS).modes
        except CannotAnswer:
            continue
        near = [[m for m in modes if abs(m.frequency_hz / f - 1) < 0.03] for f in hz]
        found += sum(map(bool, near))
        false += len(modes) - sum(map(bool, near))
        for candidates, f, z in zip(near, hz, damping, strict=True):
            for m in sorted(candidates, key=lambda m, f=f: abs(m.frequency_hz - f))[:1]:
                errors.append((m.frequency_hz / f - 1, m.damping_ratio / z - 1))
                spread.append((m.frequency_stderr / f, m.damping_stderr / z))
    e, s = 100 * np.array(errors), 100 * np.array(spread)
    bias, chance, rms = e.mean(axis=0), e.std(axis=0) / np.sqrt(len(e)), np.sqrt((e**2).mean(axis=0))
    held = 100 * np.mean(np.abs(e) < 1.96 * s, axis=0)
    print(f"ambient, {runs} runs of {samples} samples: {found} of {3 * runs} modes, {false} false")
    for k, name in enumerate(("frequency", "damping")):
        print(
            f"  {name}: bias {bias[k]:+.3f} ± {chance[k]:.3f} %, rms {rms[k]:.2f} %, median standard error "
            f"{np.median(s[:, k]):.2f} %, 95 % intervals hold {held[k]:.1f} %",
            flush=True,
        )


def record_spring(
    stiffening: float, gain: float, seed: int, binary: bool, n: int = 3000, disturbance: float = 0.1
) -> Log:
    """Return a log `force`, `place` of x'' + 2 z w x' + w^2 (x + a x^3) = w^2 (u + d), u = r - gain v, and of a second mode.

    Args:
        stiffening: a times three mean squares of x, estimated on the linear system: relative stiffening at rms.
        gain: Of the feedback of velocity, over the one that doubles the damping; 0 in open loop.
        seed: Of everything random.
        binary: Whether r is a random binary signal; else Gaussian.
        n: Samples.
        disturbance: Standard deviation of d over that of r.
    """
    rng = np.random.default_rng(seed)
    r = rng.choice([-1.0, 1.0], n) if binary else rng.normal(size=n)
    d = disturbance * rng.normal(size=n)
    # mean square of x under white samples of variance 1: w DT / (4 z), z grown by the loop
    w, z = 2 * np.pi * np.array([3.0, 7.0]), 0.03
    mean_square = w[0] * DT / (4 * z * (1 + gain))
    a, feedback = stiffening / (3 * mean_square), gain * 2 * z / w[0]
    y, u, h = np.zeros(n), np.zeros(n), DT / STEPS
    x, v = np.zeros(2), np.zeros(2)
    for t in range(n):
        y[t], u[t] = x[0] + 0.3 * x[1], r[t] - feedback * v[0]
        for _ in range(STEPS):
            v = v + h * w**2 * (u[t] + d[t] - 2 * z / w * v - x - a * np.array([x[0] ** 3, 0.0]))
            x = x + h * v
    y += 0.01 * y.std() * rng.normal(size=n)
    return Log(np.arange(n) * DT, {"force": u, "place": y}, "spring.csv")


def study_nonlinear(runs: int, seed: int) -> None:
    """Print how often identification warns of a nonlinear response."""
    for stiffening in STIFFENING:
        for gain in (0.0, 1.0):
            warned, p = 0, []
            for run in range(seed, seed + runs):
                log = record_spring(stiffening, gain, run, run % 2 == 0)
                options = {} if stiffening == 0 else {"method": "n4sid", "order": 4, "delay": 0}
                found = find_modes(log, ["force"], ["place"], **options)
                seen = found.nonlinearity
                if seen is not None:
                    warned += seen.suspected
                    p.append(seen.p_value)
            loop = "closed loop" if gain else "open loop"
            print(
                f"stiffening {100 * stiffening:g} %, {loop}: {warned} of {runs} warned; p below 0.05 in "
                f"{sum(x < 0.05 for x in p)}, below 0.001 in {sum(x < 1e-3 for x in p)}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, nargs="+", default=[20_000, 80_000])
    parser.add_argument("--only", nargs="+", choices=("ambient", "nonlinear"), default=["ambient", "nonlinear"])
    options = parser.parse_args()
    for samples in options.samples if "ambient" in options.only else ():
        study_ambient(options.runs, options.seed, samples)
    if "nonlinear" in options.only:
        study_nonlinear(options.runs, options.seed)


if __name__ == "__main__":
    main()
