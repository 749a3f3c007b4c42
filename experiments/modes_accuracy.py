"""How exact are resonances and damping from vibration logs, and how honest their intervals?

Synthetic structures with the thesis' resonances (7.4, 11.5, 14 and 103 Hz, damping 1 to 3 %) are shaken by white forces
held over each sample; outputs carry white noise of 20, 40 or 60 dB. Printed for each case: root mean square error over
the Cramer-Rao bound, before and after refinement, and how often the 95 % interval holds the truth. A second table does
the same with coloured output noise, a third looks at data under feedback with a coloured disturbance.

    python experiments/modes_accuracy.py --runs 100 --seed 1
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

from tau_dyn.modes import Record, StateSpace, compress_subspace_data, refine
from tau_dyn.modes.delay import choose_delay
from tau_dyn.modes.fit_point import assemble_normal_equations, evaluate
from tau_dyn.modes.methods import estimate_first_poles
from tau_dyn.modes.modal import find_resonances
from tau_dyn.modes.modal_form import build_modal_form, free_numbers
from tau_dyn.modes.refinement import propagate_covariance
from tau_dyn.modes.state_space import simulate, simulate_states
from tau_dyn.modes.subspace import pbsid

DT = 1 / 500
FREQUENCIES = {3: (7.4, 11.5, 14.0), 4: (7.4, 11.5, 14.0, 103.0)}
COLOUR = np.poly([0.9, 0.97 * np.exp(0.16j), 0.97 * np.exp(-0.16j)]).real  # noise with a hump at 12.7 Hz
VISIBLE = 0.15  # of the damping: where the bound itself is larger, no method can know the mode, and it is not counted
KINDS = ("white", "coloured", "delay", "feedback")
DAMPINGS = {3: (0.01, 0.02, 0.03), 4: (0.01, 0.02, 0.03, 0.015)}


def structure(n: int, rng: np.random.Generator, frequencies=None, dampings=None, channels: int = 3) -> StateSpace:
    """Return a structure of n modes with random orthonormal shapes, forces in, displacements out."""
    shapes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    w = 2 * np.pi * np.array(frequencies or FREQUENCIES[n])
    zeta = np.array(dampings or DAMPINGS[n])
    p = min(n, channels)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.diag(w**2), -np.diag(2 * zeta * w)]])
    B = np.vstack([np.zeros((n, p)), shapes[:p].T])
    held = expm(np.block([[A, B], [np.zeros((p, 2 * n + p))]]) * DT)
    C = np.hstack([shapes[:p], np.zeros((p, n))])
    return StateSpace(held[: 2 * n, : 2 * n], held[: 2 * n, 2 * n :], C, np.zeros((p, p)), np.zeros((2 * n, p)), DT)


def shaken(
    model: StateSpace, n_samples: int, snr_db: float, rng: np.random.Generator, coloured: bool = False
) -> Record:
    """Return a record of it, with noise as large as `snr_db` says on every output."""
    m, p = model.B.shape[1], len(model.C)
    names = tuple(f"u{k}" for k in range(m)), tuple(f"y{k}" for k in range(p))
    quiet = Record(rng.normal(size=(n_samples, m)), np.zeros((n_samples, p)), DT, *names)
    y = simulate(model, quiet, np.zeros(model.order))
    noise = rng.normal(size=(n_samples + 500, p))
    if coloured:
        noise = lfilter([1.0], COLOUR, noise, axis=0)
    noise = noise[500:]
    return replace(quiet, y=y + noise * y.std(axis=0) / noise.std(axis=0) * 10 ** (-snr_db / 20))


def bound(model: StateSpace, record: Record, snr_db: float, coloured: bool = False) -> np.ndarray:
    """Return the Cramer-Rao bound (modes, 2) of frequency and damping: standard deviations."""
    form = build_modal_form(model)
    direct = np.zeros(model.D.shape, dtype=bool)
    power = record.y.var(axis=0) / (1 + 10 ** (snr_db / 10))
    if coloured:  # whitening the noise filters the inputs too and leaves the innovations' power
        impulse = lfilter([1.0], COLOUR, np.eye(1, 4000)[0])
        power = power / np.sum(impulse**2)
        record = replace(record, u=lfilter(COLOUR, [1.0], record.u, axis=0))
    point = evaluate(form, np.zeros((1, len(form.poles)), dtype=complex), [record])
    normal = assemble_normal_equations(point, free_numbers(form, direct), np.diag(1 / power))
    scale = np.sqrt(np.diag(normal.H))
    inverse = np.linalg.inv(normal.H / np.outer(scale, scale)) / np.outer(scale, scale)
    covariance = propagate_covariance(form, inverse[: normal.n_model, : normal.n_model], direct, lambda f: f, form)
    return np.array([(mode.frequency_stderr, mode.damping_stderr) for mode in find_resonances(model, covariance)])


@dataclass
class Tally:
    """Errors of one estimator over the bound, run by run."""

    errors: list[np.ndarray]
    inside: list[np.ndarray]
    hidden: int = 0

    def line(self) -> str:
        """Root mean square error over the bound, frequency and damping, and the intervals' coverage."""
        if not self.errors:
            return "no model"
        ratio = np.sqrt(np.nanmean(np.square(self.errors), axis=(0, 1)))
        each = np.sqrt(np.nanmean(np.square(self.errors), axis=0))
        text = f"{ratio[0]:5.2f} {ratio[1]:5.2f} (worst mode {np.nanmax(each):5.2f} ± {self._spread():4.2f})"
        text += f" [{self.hidden} hidden]" if self.hidden else ""
        return text + (f"  {100 * np.mean(np.vstack(self.inside)):5.1f} %" if self.inside else "")

    def chance(self) -> str:
        """The worst mode of an estimator that meets the bound: 95 % of studies like this one stay below."""
        runs, rng = len(self.errors), np.random.default_rng(0)
        numbers = int(np.isfinite(self.errors[0]).sum()) if runs else 1
        worst = np.sqrt(rng.chisquare(max(runs, 1), (20_000, max(numbers, 1))) / max(runs, 1)).max(axis=1)
        return f"chance alone: worst mode below {np.quantile(worst, 0.95):4.2f}"

    def _spread(self) -> float:
        """Standard error of one mode's root mean square, as a share of the bound, where it is met."""
        return 1 / float(np.sqrt(2 * len(self.errors)))


def judged(found, truth: np.ndarray, limits: np.ndarray, tally: Tally) -> None:
    """Add one outcome to a tally; the modes nearest to the true ones count."""
    if not found:
        return
    chosen = _nearest(found, truth)
    error = np.array([(mode.frequency_hz, mode.damping_ratio) for mode in chosen]) - truth
    visible = limits[:, 1] < VISIBLE * truth[:, 1]
    tally.hidden += int((~visible).sum())
    tally.errors.append(np.where(visible[:, None], error / limits, np.nan))
    spread = np.array([(mode.frequency_stderr, mode.damping_stderr) for mode in chosen])
    if np.isfinite(spread[visible]).all() and visible.any():
        tally.inside.append((np.abs(error) < 1.96 * spread)[visible])


def accuracy(n: int, n_samples: int, snr_db: float, runs: int, seed: int, coloured: bool = False) -> None:
    """Print one line: plain subspace, refined."""
    plain, refined = Tally([], []), Tally([], [])
    for run in range(runs):
        rng = np.random.default_rng([seed, n, n_samples, int(snr_db), run])
        model = structure(n, rng)
        record = shaken(model, n_samples, snr_db, rng, coloured)
        truth = np.array([(mode.frequency_hz, mode.damping_ratio) for mode in find_resonances(model)])
        limits = bound(model, record, snr_db, coloured)
        first = compress_subspace_data([record], horizon=40).model(2 * n)
        judged(find_resonances(first), truth, limits, plain)
        judged(refine(first, [record]).modes, truth, limits, refined)
    noise = "coloured" if coloured else "white"
    print(
        f"{n} modes {n_samples:7d} samples {snr_db:3.0f} dB {noise:8s} | {plain.line()} | {refined.line()} "
        f"| {refined.chance()}",
        flush=True,
    )


def looped(model: StateSpace, n_samples: int, rng: np.random.Generator) -> Record:
    """Return a record under position feedback with one sample of delay; a coloured force disturbs the structure.

    The loop's reference is white; the disturbing force, low-passed at 4 Hz, is half as large; sensors add 1 % of noise.
    """
    n, p, m = model.order, len(model.C), model.B.shape[1]
    stiffness = 1 / np.abs(model.frequency_response(np.array([0.1])))[0].max()
    now, before = -(0.1 + 0.001 / DT) * stiffness * np.eye(m, p), 0.001 / DT * stiffness * np.eye(m, p)
    A = np.zeros((n + 2 * p, n + 2 * p))
    A[:n, :n], A[:n, n : n + p], A[:n, n + p :] = model.A, model.B @ now, model.B @ before
    A[n : n + p, :n], A[n + p :, n : n + p] = model.C, np.eye(p)
    r = rng.normal(size=(n_samples, m))
    d = 0.5 * lfilter([np.sqrt(1 - 0.95**2)], [1, -0.95], rng.normal(size=(n_samples, m)), axis=0)
    drive = np.hstack([(r + d) @ model.B.T, np.zeros((n_samples, 2 * p))])
    size = (simulate_states(A, drive, np.zeros(len(A)))[:, :n] @ model.C.T).std(axis=0)
    noise = 0.01 * size * rng.normal(size=(n_samples, p))
    drive[:, n : n + p] = noise
    x = simulate_states(A, drive, np.zeros(len(A)))
    u = r + x[:, n : n + p] @ now.T + x[:, n + p :] @ before.T
    return Record(u, x[:, :n] @ model.C.T + noise, DT, ("u0", "u1"), ("y0", "y1"), reference=r)


def under_feedback(n_samples: int, runs: int, seed: int) -> None:
    """Print the mean error of damping over runs, for methods that mind feedback and for those that do not."""
    names = ("subspace", "output error", "PBSID", "prediction error")
    errors: dict[str, list[np.ndarray]] = {name: [] for name in names}
    inside: list[list[bool]] = []
    for run in range(runs):
        rng = np.random.default_rng([seed, 99, run])
        model = structure(2, rng, (7.4, 11.5), (0.02, 0.03), channels=2)
        record = looped(model, n_samples, rng)
        truth = np.array([(mode.frequency_hz, mode.damping_ratio) for mode in find_resonances(model)])
        plain = compress_subspace_data([record], horizon=40).model(4)
        wide = pbsid([record], 6, past=30)  # four states of the structure, two of the disturbance
        full = refine(wide, [record], kind="prediction_error")
        found = (find_resonances(plain), refine(plain, [record]).modes, find_resonances(wide), full.modes)
        for name, modes in zip(names, found, strict=True):
            if modes:
                chosen = _nearest(modes, truth)
                errors[name].append(np.array([mode.damping_ratio for mode in chosen]) / truth[:, 1] - 1)
        if full.modes:
            chosen = _nearest(full.modes, truth)
            inside.append(
                [abs(m.damping_ratio - z) < 1.96 * m.damping_stderr for m, z in zip(chosen, truth[:, 1], strict=True)]
            )
    print(f"damping under feedback, coloured force, {n_samples} samples: mean error of each mode (its standard error)")
    for name, found in errors.items():
        mean, spread = np.mean(found, axis=0), np.std(found, axis=0) / np.sqrt(len(found))
        text = "   ".join(f"{100 * a:+7.1f} % ({100 * b:.1f})" for a, b in zip(mean, spread, strict=True))
        print(f"    {name:18s} {text}")
    print(
        f"    95 % intervals of the prediction-error estimate hold the truth: {100 * np.mean(inside):.1f} %", flush=True
    )


def _nearest(modes, truth: np.ndarray) -> list:
    """The mode nearest to each true one, frequency first, damping where two are as near."""
    return [min(modes, key=lambda m: abs(m.frequency_hz / f - 1) + abs(m.damping_ratio - z)) for f, z in truth]


def delays(n_samples: int, runs: int, seed: int) -> None:
    """Print how often a delay of five samples is found."""
    for snr_db in (20, 40, 60):
        chosen = []
        for run in range(runs):
            rng = np.random.default_rng([seed, 5, snr_db, run])
            record = shaken(replace(structure(3 + run % 2, rng), delay=5), n_samples, snr_db, rng)
            found = choose_delay([record], lambda records, delay: estimate_first_poles("n4sid", records, delay=delay))
            chosen.append(found.delay)
        print(f"delay of 5 samples, {n_samples} samples, {snr_db} dB: found in {chosen.count(5)} of {runs}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--samples", type=int, nargs="+", default=[5_000, 50_000])
    parser.add_argument("--what", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--modes", type=int, nargs="+", choices=(3, 4), default=[3, 4])
    parser.add_argument("--snr", type=int, nargs="+", default=[20, 40, 60], metavar="DB")
    options = parser.parse_args()
    print("RMSE / Cramer-Rao bound of frequency and damping; 95 % intervals that hold the truth")
    print("structure                              | subspace (CVA)                   | refined")
    for n_samples, n, snr_db in product(options.samples, options.modes, options.snr):
        if "white" in options.what:
            accuracy(n, n_samples, snr_db, options.runs, options.seed)
    for n in options.modes:
        if "coloured" in options.what:
            accuracy(n, min(options.samples), 40, options.runs, options.seed, coloured=True)
    if "delay" in options.what:
        delays(min(options.samples), min(options.runs, 10), options.seed)
    if "feedback" in options.what:
        under_feedback(50_000, options.runs, options.seed)


if __name__ == "__main__":
    main()
