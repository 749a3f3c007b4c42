"""How much of a hobby servo's friction follows its load, and does the sign of power show? XL330 with a pendulum, measured.

    python experiments/xl330_friction.py [FOLDER]

In: `xl330/` of the data (by default `$TAU_DYN_DATA`). The known pendulum's torque and each friction law are fitted to
the share of the supply that the position gain asks for: kp (goal - position), at most one, times the supply voltage. Two gains
train, the third judges. Out: what is left of that share at the third, in per cent, and the fitted coefficients. It is an error of
the equation of motion, not of a simulated position. Samples slower than 0.15 rad/s and with the torque off are left out.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import nnls

from tau_dyn.effects import EFFECTS, Motion
from tau_dyn.log import decimate, differentiate, lowpass

DATA = Path(os.environ.get("TAU_DYN_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
GAINS = {"kp100": 0.2868, "kp200": 0.5736, "kp800": 2.294}
"""Share of the supply that an error of one rad asks for, by the names of logs."""
INERTIA, WEIGHT, SUPPLY = 0.49 * 0.1**2, 0.49 * 9.81 * 0.1, 7.4  # kg m2, N m, V
RATE_HZ, POSITION_HZ, FORCE_HZ, STEP, SLOW = 200.0, 12.0, 10.0, 5, 0.15  # Hz, Hz, Hz, samples, rad/s
SPEEDS, DISTANCES = (0.1, 0.3, 1.0, 3.0), (0.003, 0.01, 0.03, 0.1)  # rad/s, rad
LAWS: dict[str, list[dict[str, float]]] = {
    "": [{}], "load_friction": [{}], "directional_efficiency": [{}], "stribeck": [{"speed": x} for x in SPEEDS],
    "static_friction": [{"speed": x} for x in SPEEDS], "lugre": [{"distance": x} for x in DISTANCES],
}  # fmt: skip


def read_motion(path: Path, gain: float) -> tuple[Motion, np.ndarray, np.ndarray]:
    """Return the motion, the share of the supply (N,) and which samples count (N,)."""
    d = pd.read_csv(path).groupby("t", as_index=False).first()
    t = np.arange(d.t.iloc[0], d.t.iloc[-1], 1 / RATE_HZ)
    raw, goal, volts, on = (
        np.interp(t, d.t, d[c].astype(float)) for c in ("position", "goal_position", "input_volts", "torque_enable")
    )
    q = lowpass(raw[:, None], POSITION_HZ, RATE_HZ)
    v = differentiate(q, 1 / RATE_HZ, accuracy=4)
    torque = INERTIA * differentiate(v, 1 / RATE_HZ, accuracy=4) + WEIGHT * np.sin(q)
    signals = {"load": np.abs(torque), "reducer_torque": torque, "reversal": np.zeros_like(q)}
    motion = Motion.of(("x",), q, v, torque, np.tanh(v / (SLOW / 3)), t=t, signals=signals)
    return motion, np.clip(gain * (goal - raw), -1, 1) * volts / SUPPLY, (on > 0.999) & (np.abs(v[:, 0]) > SLOW)


def build_rows(logs: list, law: str, settings: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns (n, k), torque first, and the share of the supply (n,) of all logs."""
    W, y = [], []
    for motion, share, counts in logs:
        effects = [EFFECTS["symmetric_friction"](["x"], ["N m"])]
        effects += [EFFECTS[law](["x"], ["N m"]).with_settings(**settings)] if law else []
        parts = [motion.signals["reducer_torque"], *(e.columns(motion)[:, 0] for e in effects)]
        rows, seen = np.column_stack([*parts, share]), counts[:, None].astype(float)
        rows, seen = (decimate(lowpass(x, FORCE_HZ, RATE_HZ), STEP) for x in (rows, seen))
        W.append(rows[seen[:, 0] > 0.9, :-1])
        y.append(rows[seen[:, 0] > 0.9, -1])
    return np.concatenate(W), np.concatenate(y)


def main() -> None:
    """Print each law's held-out error at each gain."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else DATA) / "xl330"
    logs = {g: [read_motion(p, x) for p in sorted(folder.glob(f"{g}_*.csv"))] for g, x in GAINS.items()}
    for law, grid in LAWS.items():
        for gain in GAINS:
            train = [log for other in GAINS if other != gain for log in logs[other]]
            fits = [(*nnls(*build_rows(train, law, row))[::-1], row) for row in grid]
            _, values, row = min(fits, key=lambda fit: fit[0])
            W, y = build_rows(logs[gain], law, row)
            left = 100 * np.sqrt(np.mean((y - W @ values) ** 2) / np.mean(y**2))
            print(f"Coulomb, viscous {law}: {left:.1f} % left at {gain}; {np.round(values / values[0], 4)} {row}")


if __name__ == "__main__":
    main()
