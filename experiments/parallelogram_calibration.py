"""The calibration paper's parallelogram (Savoure et al. 2006, section III): what each way of calibrating leaves at the tool.

19 poses, noise 0.003 mm and 0.003 deg, the errors of Table 2, tool lengths 0 and 200 mm. The real mechanism is
simulated in closed form, the library works from the robot file. Printed: which parameters can be told, the largest TCP
error of each method (median and 95 % quantile of all runs), and the same for other errors drawn at random. Figures as
the paper's 5 to 7.

    python experiments/parallelogram_calibration.py --runs 100 --seed 7 [--out out/parallelogram]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from parallelogram_parts import methods
from parallelogram_parts.explicit import ERRORS, NAMES, NOMINAL, printed_sensitivity, sensitivity

from tau_dyn.calibrate.unknowns import find_identifiable

LENGTHS = (0.0, 0.2)
LABELS = {
    "none": "no calibration",
    "classical": "classical, q0 and l",
    "linear_si": "paper's linear method, not weighted (m, rad)",
    "linear_mm": "paper's linear method, not weighted (mm, rad)",
    "linear": "paper's linear method, weighted by the noises (mm, deg)",
    "linear_exact": "the same parameters, exact compensation",
    "six": "nonlinear, 6 parameters, exact compensation",
    "own": "nonlinear, 9 with prior 10 mm, 0.57 deg, exact",
    "nine_linear": "nonlinear, 9 with prior 2 mm, 0.1 deg, linear comp.",
    "nine": "nonlinear, 9 with prior 2 mm, 0.1 deg, exact",
    "truth": "true parameters, exact compensation",
}


def told() -> None:
    """Print which parameters can be told and how the others regroup."""
    _, geometry = methods.machine(0.1)
    columns = geometry.tool_by_parameter(NOMINAL, methods.MEASURED[:, None], None)[:, [0, 2, 4]]  # type: ignore[arg-type]
    scaled = columns / np.array([methods.NOISE[0], methods.NOISE[0], methods.NOISE[1]])[None, :, None]
    found = find_identifiable(scaled.reshape(-1, 9), NAMES, np.full(9, 1e-3), geometry.priority)
    print(f"identifiable: {found.rank} of 9; condition number {found.condition_number:.3g}")
    for row, k in enumerate(found.kept):
        text = "".join(
            f" {f:+.6g} {NAMES[d]}" for f, d in zip(found.factors[row], found.dropped, strict=True) if abs(f) > 1e-9
        )
        print(f"  {NAMES[k]}{text}")
    q = methods.MEASURED
    own, printed = sensitivity(q, 0.1), printed_sensitivity(q, 0.1)
    rank = [np.linalg.matrix_rank(x.reshape(-1, 9), 1e-8) for x in (own, printed)]
    print(f"  engine against closed form: {np.abs(columns - own * np.array([1, 1, -1])[None, :, None]).max():.1e}")
    print(f"  rank by (65) derived anew {rank[0]}, as printed {rank[1]}")


def corrected(h: float, found: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return corrected positions (N,) of every method at tool length `h`."""
    q, (q0, length) = methods.CHECKED, found["classical"]
    simple = np.arcsin(np.clip(NOMINAL[7] * np.sin(q) / length, -1, 1)) - q0
    by = _compensate(h)
    return {
        "none": q,
        "classical": simple,
        "linear_si": by(found["linear_si"], "linear"),
        "linear_mm": by(found["linear_mm"], "linear"),
        "linear": by(found["linear"], "linear"),
        "linear_exact": by(found["linear"], "exact"),
        "six": by(found["six"], "exact"),
        "own": by(found["own"], "exact"),
        "nine_linear": by(found["nine"], "linear"),
        "nine": by(found["nine"], "exact"),
        "truth": by(found["truth"], "exact"),
    }


def calibrated(rng: np.random.Generator, k: np.ndarray) -> dict[str, np.ndarray]:
    """Return what each method makes of one set of measured poses."""
    _, geometry = methods.machine(0.1)
    poses = methods.measure(rng, k)
    return {
        "classical": np.array(methods.classical(poses)),
        "linear_si": methods.linear(geometry, poses, (1.0, 1.0)),
        "linear_mm": methods.linear(geometry, poses, (1e3, 1.0)),
        "linear": methods.linear(geometry, poses, (1 / methods.NOISE[0], 1 / methods.NOISE[1])),
        "six": methods.six(geometry, poses).theta,
        "own": methods.nine(geometry, poses).theta,
        "nine": methods.nine(geometry, poses, methods.PRIOR).theta,
        "truth": k,
    }


def study(runs: int, seed: int, scatter: float) -> dict[str, np.ndarray]:
    """Return the largest TCP error (runs, 2) [m] of each method at both tool lengths.

    Args:
        runs: How many sets of measurements.
        seed: Of their noise.
        scatter: 0 for Table 2's errors, otherwise the standard deviation [m] of errors drawn anew in every run.
    """
    out = {name: np.zeros((runs, 2)) for name in LABELS}
    for run, rng in enumerate(np.random.default_rng(seed).spawn(runs)):
        k = NOMINAL + ERRORS
        if scatter:
            k = NOMINAL + rng.normal(0, scatter, 9) * np.where(np.arange(9) == 0, 0.3, 1.0)
        found = calibrated(rng, k)
        for j, h in enumerate(LENGTHS):
            for name, q in corrected(h, found).items():
                out[name][run, j] = np.abs(methods.tcp_error(h, q, k)).max()
    return out


def shown(title: str, result: dict[str, np.ndarray]) -> str:
    """Return a table: median and 95 % quantile of all runs [um]."""
    lines = [title, f"| {'':55} | h = 0: median | 95 % | h = 200 mm: median | 95 % |", "|---|---|---|---|---|"]
    for name, label in LABELS.items():
        a, b = 1e6 * result[name].T
        high = [float(np.quantile(x, 0.95)) for x in (a, b)]
        lines.append(f"| {label:55} | {np.median(a):.1f} | {high[0]:.1f} | {np.median(b):.1f} | {high[1]:.1f} |")
    return "\n".join(lines)


def figure(seed: int, path: Path) -> None:
    """Draw the TCP error over q as the paper's Figures 5 to 7, for one set of measurements."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    found = calibrated(np.random.default_rng(seed), NOMINAL + ERRORS)
    shown_as = {"none": "C3", "classical": "C0", "linear": "C2", "six": "C1", "nine": "k"}
    fig, axes = plt.subplots(2, 2, figsize=(10, 6.5), sharex=True)
    for column, h in zip(axes.T, LENGTHS, strict=True):
        for name, q in corrected(h, found).items():
            if name not in shown_as:
                continue
            error = methods.tcp_error(h, q)
            column[0].plot(np.degrees(methods.CHECKED), 1e3 * error, shown_as[name], label=LABELS[name])
            if name not in ("none", "classical"):
                column[1].plot(np.degrees(methods.CHECKED), 1e6 * error, shown_as[name], label=LABELS[name])
        column[0].set(title=f"h = {1e3 * h:.0f} mm", ylabel="TCP error along x [mm]")
        column[1].set(xlabel="q [deg]", ylabel="TCP error along x [um]")
    axes[0, 1].legend(fontsize=8)
    axes[1, 1].legend(fontsize=8)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    fig.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, dpi=110)


def _compensate(h: float):
    robot, geometry = methods.machine(h)

    def by(k: np.ndarray, method: str) -> np.ndarray:
        build = methods.build_compensation(robot, geometry, k, method=method, limits=False)
        return build(methods.CHECKED[:, None]).q[:, 0]

    return by


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--out", type=Path, default=Path("out/parallelogram"))
    given = parser.parse_args()
    told()
    print(shown("\nTable 2's errors, largest |error| over -45..45 deg [um]", study(given.runs, given.seed, 0.0)))
    print(shown("\nerrors drawn at random, 1 mm and 0.017 deg", study(given.runs, given.seed + 1, 1e-3)))
    figure(given.seed, given.out / "parallelogram.png")


if __name__ == "__main__":
    main()
