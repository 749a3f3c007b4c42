"""Table 6.4: which frequencies a push along x or y leaves in x and y, with the wrist, at the gauges."""

from dataclasses import dataclass

import numpy as np

from tau_dyn.log import Log
from tau_dyn.mechanism import L1_DRIVES
from tau_dyn.simulate import VibrationSensors, push_log
from thesis_6_3_parts.robots import with_wrist

WIDTHS = (0.006, 0.01, 0.014, 0.02)  # s, one push each
BAND = (3.0, 30.0)  # Hz
EARLY, LATE = (0.03, 0.6), (2.0, 5.5)  # s after the push


@dataclass(frozen=True, eq=False)
class PushStudy:
    """Strongest frequencies by (force, output): whole decay, its beginning and its end, (pushes,) Hz each."""

    whole: dict[tuple[str, str], np.ndarray]
    early: dict[tuple[str, str], np.ndarray]
    late: dict[tuple[str, str], np.ndarray]
    logs: dict[str, Log]


def study(seed: int) -> PushStudy:
    found: tuple[dict, dict, dict] = ({}, {}, {})
    logs = {}
    sensors = VibrationSensors.length_gauges()
    for force in "xy":
        runs = [
            push_log(with_wrist(), force, duration=6, width=w, drives=L1_DRIVES, sensors=sensors, seed=seed + k)
            for k, w in enumerate(WIDTHS)
        ]
        logs[force] = runs[1]
        for output in "xy":
            for table, span in zip(found, ((EARLY[0], LATE[1]), EARLY, LATE), strict=True):
                table[force, output] = np.array([_strongest(log, force, output, span) for log in runs])
    return PushStudy(*found, logs)


def _strongest(log: Log, force: str, output: str, span: tuple[float, float]) -> float:
    """Return the highest peak of the spectrum [Hz], over a span after the push, between 3 and 30 Hz."""
    pushed = np.flatnonzero(log.channels[f"f{force}_tool"])[-1]
    first, last = (pushed + round(t / log.dt) for t in span)
    y = log.channels[f"{output}_tool"][first:last]
    y = (y - y.mean()) * np.hanning(len(y))
    n = 2**18
    f, power = np.fft.rfftfreq(n, log.dt), np.abs(np.fft.rfft(y, n))
    inside = (f > BAND[0]) & (f < BAND[1])
    return float(f[inside][np.argmax(power[inside])])
