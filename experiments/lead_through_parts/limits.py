"""Is the predicted stability limit the one of the whole arm, and what gives 68 Hz?"""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.optimize import root_scalar

from lead_through_parts.contact import Hand, ServoArm, run_contact
from lead_through_parts.contact_work import CompliantSurface
from lead_through_parts.scene import PLATE, START, UP, robot, settings
from tau_dyn.control.lead_through import ForceLoop, LeadThrough

THESIS_HZ = 68.0
CASES = [(69.1, 0, 0.0), (69.1, 1, 0.0), (20.0, 0, 0.0), (20.0, 0, 60.0), (8.0, 3, 0.0)]
IDLE = Hand([0.0], np.zeros((1, 3)), stiffness=0.0, damping=0.0)


def study() -> pd.DataFrame:
    """Return predicted and simulated limits, one row a case."""
    return pd.DataFrame([row(*case) for case in CASES])


def row(servo: float, delay: int, damping: float) -> dict:
    loop = ForceLoop(servo_hz=servo, delay=delay)
    limit = loop.limit(PLATE, damping)
    low, high = 0.8 * limit.gain, 1.2 * limit.gain
    for _ in range(7):
        middle = (low + high) / 2
        low, high = (low, middle) if grows(loop, middle, damping)[0] else (middle, high)
    hz = grows(loop, high, damping)[1]
    return {
        "servo [Hz]": servo,
        "delay [samples]": delay,
        "contact damping [N s/m]": damping,
        "predicted K k [1/s]": limit.gain * PLATE,
        "simulated K k [1/s]": (low + high) / 2 * PLATE,
        "predicted [Hz]": limit.hz,
        "simulated [Hz]": hz,
    }


def grows(loop: ForceLoop, gain: float, damping: float) -> tuple[bool, float]:
    """Return whether a small disturbance grows on the whole arm, and its frequency [Hz]."""
    arm = ServoArm(robot(), START, servo_hz=loop.servo_hz, delay=loop.delay)
    law = LeadThrough(settings(gain, 1.0, correction_range=0.0, loop=loop))
    surface = CompliantSurface(arm.pose.position + 1.95 / PLATE * UP, UP, PLATE, damping=damping)
    force = run_contact(arm, law, surface, IDLE, 1.6, fine=1).tool_wrench[:, 2] - 2.0
    spectrum = np.abs(np.fft.rfft(force * np.hanning(len(force)), 8 * len(force)))
    hz = float(np.fft.rfftfreq(8 * len(force), 0.004)[np.argmax(spectrum)])
    full = np.ptp(force[300:]) > 1.0  # a limit cycle, reached long ago
    return bool(full or np.ptp(force[300:]) > np.ptp(force[100:200])), hz


def what_gives_68() -> pd.DataFrame:
    """Return servo bandwidths that put the oscillation at 68 Hz, for contacts with and without damping."""
    rows = []
    for lead in (0.0, 0.0005, 0.001, 0.002):  # c / k [s]

        def off(hz: float, lead: float = lead) -> float:
            return ForceLoop(servo_hz=hz).limit(1.0, lead).hz - THESIS_HZ

        servo = root_scalar(off, bracket=(5.0, 100.0)).root if off(5.0) * off(100.0) < 0 else np.nan
        product = ForceLoop(servo_hz=servo).limit(1.0, lead).gain if np.isfinite(servo) else np.nan
        rows.append({"contact c / k [ms]": 1e3 * lead, "servo [Hz]": servo, "limit K k [1/s]": product})
    return pd.DataFrame(rows)
