"""Surface tracking with and without tool force control, and the oscillation on a plate, its causes and cures."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lead_through_parts.contact import ContactRun, ContactSensors
from lead_through_parts.scene import CARDBOARD, PLATE, SERVO_HZ, BuildLaw, settings, track
from tau_dyn.control.lead_through import ForceLoop, LeadThrough

GAIN = 0.0128  # 93 % of the plate's limit, 4 % of cardboard's
HALF = 0.5 * ForceLoop(servo_hz=SERVO_HZ).limit(PLATE).gain
SILENT = ContactSensors()


def cases() -> dict[str, tuple]:
    """Return what is run: settings, stiffness and options of `track`, by name."""

    def given(reach: float, gain: float = GAIN, **changed):
        return settings(gain, CARDBOARD, correction_range=np.radians(reach), **changed)

    calm = {"normal_hz": 2.0}
    return {
        "cardboard, handle alone": (given(10, tool_force=False), CARDBOARD, {}),
        "cardboard, two sensors": (given(10), CARDBOARD, {}),
        "cardboard, two sensors, calm normal and watch": (given(10, watch=True, **calm), CARDBOARD, {}),
        "plate, 0 deg": (given(0), PLATE, {}),
        "plate, 5 deg": (given(5), PLATE, {}),
        "plate, 10 deg": (given(10), PLATE, {}),
        "plate, 10 deg, hand at rest": (given(10), PLATE, {"moves": False}),
        "plate, 10 deg, sensor without noise": (given(10), PLATE, {"noise": SILENT}),
        "plate, 10 deg, gain 109 % of the limit": (given(10, 0.015), PLATE, {}),
        "cure: half the limit": (given(10, HALF), PLATE, {}),
        "cure: calm normal": (given(10, **calm), PLATE, {}),
        "cure: watch": (given(10, watch=True), PLATE, {}),
        "cure: calm normal and watch": (given(10, watch=True, **calm), PLATE, {}),
        "cure: the same from 3.6 times the limit": (given(10, 0.05, watch=True, **calm), PLATE, {}),
    }


def study(runs: int, seed: int, law: BuildLaw = LeadThrough) -> tuple[pd.DataFrame, dict[str, ContactRun]]:
    """Return a table of means over runs, and the first run of each case."""
    rows, first = [], {}
    for name, (given, stiffness, options) in cases().items():
        made = [track(given, stiffness, seed + k, law=law, **options) for k in range(runs)]
        first[name] = made[0]
        rows.append({"case": name} | pd.DataFrame([measures(run) for run in made]).mean().to_dict())
    return pd.DataFrame(rows), first


def measures(run: ContactRun) -> dict[str, float]:
    """Return what the tool felt: the peak of all 7 s, the rest while it moved, from 2 s on."""
    part = run.between(2.0, 7.0)
    force = part.tool_wrench[:, 2]
    dt = float(np.median(np.diff(part.t)))
    spectrum = np.abs(np.fft.rfft((force - force.mean()) * np.hanning(len(force))))
    hz = np.fft.rfftfreq(len(force), dt)
    fast = np.where(hz > 20, spectrum, 0)
    return {
        "peak [N]": float(run.tool_force.max()),
        "mean [N]": float(force.mean()),
        "std [N]": float(force.std()),
        "least [N]": float(force.min()),
        "most [N]": float(force.max()),
        "lost [%]": 100 * float(np.mean(force <= 0)),
        "fast peak [Hz]": float(hz[np.argmax(fast)]),
        "fast std [N]": float(np.sqrt(2 * np.sum(fast**2) / np.sum(np.hanning(len(force)) ** 2) / len(force))),
    }
