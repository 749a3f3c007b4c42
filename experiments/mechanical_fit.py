"""M, D and K from simulated vibration logs: how near, how honest, and never `identified` when they are not.

    python experiments/mechanical_fit.py [--runs 20] [--seed 0] [--masses 3] [--snr 20] [--samples 5000 20000 50000]
                                         [--partial] [--thesis] [--out DIR]

In: nothing. Every run draws its own structure: masses joined to each other and to the ground by springs, lowest resonance at
7.4 Hz, damping ratios near 1 to 3 % and not proportional. White forces held over each of 4 ms, displacements with white noise.
The engine is the package's own: CVA subspace, output-error refinement, then M, D, K.

Out: `mechanical_fit.csv`, one row a run and number of samples, with errors in per cent of each matrix' norm, the part of 95 %
intervals that hold the truth, and the errors of the thesis' unconstrained route on the same refined model. With --partial
instead: every choice of sensors and forces on one structure a run, at the largest number of samples, once with a model of the
true order and once with one mode too few (`mechanical_partial.csv`). With --thesis: what the printed matrices of section 6.3
amount to. Some seconds a run, two minutes a run with --partial.
"""

import argparse
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.linalg import eigh
from thesis_6_3_parts.matrices import PRINTED, judge_character, solve_unconstrained

from tau_dyn.modes import Record, RefinedModel, compress_subspace_data, refine
from tau_dyn.modes.mechanical import Mechanical, SecondOrder, fit_mechanical
from tau_dyn.modes.mechanical.structure import pack
from tau_dyn.modes.state_space import simulate

DT = 0.004  # [s], the thesis' 250 Hz
LOWEST_HZ = 7.4
HIGHEST_HZ = 60.0


def draw(n: int, rng: np.random.Generator) -> SecondOrder:
    """Return masses with springs between all of them and to the ground; no two resonances closer than 8 %."""
    while True:
        M = np.diag(rng.uniform(2.0, 15.0, n))
        K, D = np.zeros((n, n)), np.zeros((n, n))
        for i, j in zip(*np.triu_indices(n), strict=True):
            arm = np.eye(n)[i] - (np.eye(n)[j] if i != j else 0)
            spring, ratio = rng.lognormal(0.0, 0.8), rng.uniform(0.6, 1.6)
            K, D = K + spring * np.outer(arm, arm), D + ratio * spring * np.outer(arm, arm)
        K *= (2 * np.pi * LOWEST_HZ) ** 2 / eigh(K, M, eigvals_only=True)[0]
        value, shape = eigh(K, M)
        w = np.sqrt(value)
        D *= np.mean(0.04 * w) / np.mean(np.diag(shape.T @ D @ shape))
        hz = w / (2 * np.pi)
        ratio = np.diag(shape.T @ D @ shape) / (2 * w)
        if hz[-1] < HIGHEST_HZ and np.all(np.diff(hz) > 0.08 * hz[:-1]) and 0.005 < ratio.min() and ratio.max() < 0.05:
            return SecondOrder(M, D, K)


def record(truth: SecondOrder, driven, sensed, n: int, snr_db: float, rng: np.random.Generator) -> Record:
    """Return a test with white unit forces and white noise on every displacement."""
    names = [tuple(f"{kind}{d}" for d in dofs) for kind, dofs in (("f", driven), ("x", sensed))]
    quiet = Record(rng.standard_normal((n, len(driven))), np.zeros((n, len(sensed))), DT, *names)
    x = simulate(truth.sampled(DT, driven, sensed), quiet, np.zeros(2 * len(truth.M)))
    noise = 10 ** (-snr_db / 20) * x.std(axis=0) * rng.standard_normal(x.shape)
    return Record(quiet.u, x + noise, DT, *names)


def engine(test: Record, order: int) -> RefinedModel:
    """Return the refined model of a test."""
    start = compress_subspace_data([test]).model(order, direct=False)
    return refine(start, [test], direct=False)


def per_cent(found: np.ndarray, truth: np.ndarray) -> float:
    return 100 * float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def trial(truth: SecondOrder, n: int, snr_db: float, rng: np.random.Generator) -> dict:
    """Return one row: errors of ours and of the thesis' route."""
    dofs = range(len(truth.M))
    model = engine(record(truth, dofs, dofs, n, snr_db, rng), 2 * len(truth.M))
    found, plain = fit_mechanical(model), solve_unconstrained(model.model)
    row = {"samples": n, "status": found.status, "why": found.why, "consistency": found.consistency}
    row |= {f"{name}_thesis": per_cent(getattr(plain, name), getattr(truth, name)) for name in "MDK"}
    said = judge_character(plain)
    row |= {"skew_thesis": 100 * said.asymmetry.max(), "indefinite_thesis": bool(said.lowest.min() < 0)}
    return row | (against(found, truth) if found.structure is not None else {})


def against(found: Mechanical, truth: SecondOrder) -> dict:
    """Return errors [%] and what the intervals cover."""
    still = np.linalg.inv(truth.K)
    row = {name: per_cent(getattr(found, name), getattr(truth, name)) for name in "MDK"}
    row["static"] = per_cent(found.static_compliance, still)
    inside = np.abs(pack(found.structure) - pack(truth)) < 1.96 * pack(found.stderr)
    row |= {f"cover_{name}": float(np.mean(part)) for name, part in zip("MDK", np.split(inside, 3), strict=True)}
    row["cover_static"] = float(
        np.mean(np.abs(found.static_compliance - still) < 1.96 * found.static_compliance_stderr)
    )
    row["definite"] = all(np.linalg.eigvalsh(getattr(found, name))[0] > -1e-9 * np.linalg.norm(getattr(found, name))
                          and np.array_equal(getattr(found, name), getattr(found, name).T) for name in "MDK")  # fmt: skip
    return row


def accuracy(args: argparse.Namespace) -> None:
    rows = []
    for run in range(args.runs):
        truth = draw(args.masses, np.random.default_rng([5, args.seed, run]))
        for n in args.samples:
            rows.append({"run": run} | trial(truth, n, args.snr, np.random.default_rng([6, args.seed, run, n])))
    table = pd.DataFrame(rows)
    table.to_csv(args.out / "mechanical_fit.csv", index=False)
    for n, part in table.groupby("samples"):
        kept = part[part["status"] == "identified"]
        print(f"\n{args.masses} masses, {args.snr:g} dB, {n} samples: {len(kept)} of {len(part)} identified, "
              f"{kept['definite'].sum()} of them symmetric and definite")  # fmt: skip
        for text, names in (("ours   ", ["M", "D", "K", "static"]), ("thesis ", ["M_thesis", "D_thesis", "K_thesis"])):
            shown = [f"{x[0] if x != 'static' else x} {np.median(kept[x]):.2f} / {kept[x].max():.2f}" for x in names]
            print(f"  {text} error, median / worst [%]: " + ", ".join(shown))
        met = (kept["M"] <= 1) & (kept["D"] <= 2) & (kept["K"] <= 1)
        covered = [f"{x} {100 * kept[f'cover_{x}'].mean():.1f}" for x in ("M", "D", "K", "static")]
        print(f"  within 1 / 2 / 1 %: {met.sum()}; static compliance within 1 %: {(kept['static'] <= 1).sum()}; "
              f"95 % intervals hold [%]: {', '.join(covered)}")  # fmt: skip
        print(f"  thesis' route: skew part up to {part['skew_thesis'].max():.1f} %, "
              f"an indefinite matrix in {part['indefinite_thesis'].sum()}")  # fmt: skip


def partial(args: argparse.Namespace) -> None:
    n, rows = args.masses, []
    chosen = [c for k in range(1, n + 1) for c in combinations(range(n), k)]
    for run in range(args.runs):
        truth = draw(n, np.random.default_rng([5, args.seed, run]))
        for k, (sensed, driven) in enumerate(product(chosen, chosen)):
            test = record(
                truth, driven, sensed, max(args.samples), args.snr, np.random.default_rng([7, args.seed, run, k])
            )
            shared = [(driven.index(d), sensed.index(d)) for d in driven if d in sensed]
            for short in (0, 1):
                found = fit_mechanical(engine(test, 2 * (n - short)), collocated=shared)
                row = {"run": run, "sensed": sensed, "driven": driven, "modes": n - short, "status": found.status,
                       "whole": bool(shared) and len({*sensed, *driven}) == n and not short,
                       "why": found.why, "valid_hz": found.valid_hz, "consistency": found.consistency}  # fmt: skip
                if found.structure is not None:
                    dofs = [*sensed, *(d for d in driven if d not in sensed)]
                    still = np.linalg.inv(truth.K)[np.ix_(dofs, dofs)][: len(found.K), : len(found.K)]
                    row["static"] = per_cent(found.static_compliance, still)
                rows.append(row)
    table = pd.DataFrame(rows)
    table.to_csv(args.out / "mechanical_partial.csv", index=False)
    for modes, part in table.groupby("modes", sort=False):
        wrong = part[(part["status"] == "identified") & ~part["whole"]]
        print(f"\n{n} masses, {args.snr:g} dB, {max(args.samples)} samples, models of {modes} modes, {len(part)} choices of "
              f"sensors and forces: {len(wrong)} called identified that are not")  # fmt: skip
        print(part.groupby(["whole", "status"]).size().to_string())
        for status, same in part.groupby("status"):
            if same["static"].notna().any():
                print(f"{status}: static compliance off by {same['static'].median():.2f} (median), "
                      f"{same['static'].max():.2f} % (worst)")  # fmt: skip


def thesis() -> None:
    said = judge_character(PRINTED)
    print("the thesis' printed matrices (6.3):")
    print("  eigenvalues of K:", np.round(said.stiffness_eigenvalues, 1))
    print("  roots lambda of det(M lambda + K) = 0 [1/s^2]:", np.round(said.undamped_roots.real, 1))
    print("  sqrt|lambda| / 2 pi, D left out [Hz]:", np.round(said.undamped_hz, 1))
    print("  poles with D [rad/s]:", np.round(np.sort(said.poles.real), 1), f", {said.n_unstable} unstable")
    print("  skew part of M, D, K:", np.round(said.asymmetry, 2))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--masses", type=int, default=3)
    parser.add_argument("--snr", type=float, default=20.0, metavar="DB")
    parser.add_argument("--samples", type=int, nargs="+", default=[5000, 20000, 50000])
    parser.add_argument("--partial", action="store_true")
    parser.add_argument("--thesis", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.thesis:
        thesis()
    else:
        (partial if args.partial else accuracy)(args)
