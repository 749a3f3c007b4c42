"""How fast does an error go from trial to trial, frequency by frequency, and what was predicted?

Without noise `u_{k+1} - u_k = H (u_k - u_{k-1})`, `H = Q (I - L T)` of (7.27), (7.28). So the size of a change at a frequency
over that of the change before it is measured, and `|Q (1 - L T)|` of the identified actuators predicted.
"""

from dataclasses import dataclass

import numpy as np
from ilc_parts.carts import DT, ROBOT, Carts, build_way

from tau_dyn.control.iterative import (
    LearningHistory,
    LearningLaw,
    MotorSide,
    TimeShift,
    analyse_convergence,
    compute_frequency_condition,
    design_low_pass,
    learn,
    stack_controlled_actuators,
)
from tau_dyn.modes import Actuator, Record, fit_actuators

BANDS = ((0.5, 2.0), (2.0, 4.0), (4.0, 6.0), (6.0, 8.0), (8.0, 10.0))  # Hz
CHANGES = 3  # that are compared; later ones are lost in the encoders' noise
SIZE = 5e-4  # m Hz, of the sines that the actuators are identified on; each has it over its frequency
GAIN, CUTOFF = 0.9, 10.0  # of L, and of Q [Hz], as in the thesis


@dataclass(frozen=True, eq=False)
class Rates:
    """Rates of one learning.

    Attributes:
        predicted: By band, the mean over the carts (b,).
        measured: Likewise (b,).
        singular: Largest singular value of H, (7.28).
        whole: Size of a change over that of the change before, all frequencies, the largest of all carts.
        history: The learning.
    """

    predicted: np.ndarray
    measured: np.ndarray
    singular: float
    whole: float
    history: LearningHistory


def identify_actuators(friction: bool, seed: int) -> list[Actuator]:
    """Return (6.11) of the three carts, fitted to 6 s of sines from 0.5 to 12 Hz."""
    rng, t = np.random.default_rng(seed), np.arange(1500) * DT
    f = np.arange(0.5, 12.1, 0.5)
    phase = rng.uniform(0, 2 * np.pi, (3, len(f)))
    waves = np.array([np.sum(SIZE / f * np.sin(2 * np.pi * f * t[:, None] + p), axis=1) for p in phase]).T
    moved = np.clip(t - 0.1, 0, 1)[:, None] ** 2 * waves
    seen = Carts(friction, seed).run(ROBOT.home + moved, 99).q - ROBOT.home
    record = Record(moved, seen, DT, ROBOT.actuated, ROBOT.actuated, "sines")
    return [fit.actuator for fit in fit_actuators([record])]


def measure_rates(friction: bool, seed: int) -> Rates:
    """Return predicted and measured rates of one seed's learning."""
    actuators = identify_actuators(friction, seed)
    shift = round(float(np.mean([(a.delay + a.time_constant) / DT for a in actuators])))
    side = MotorSide(stack_controlled_actuators(actuators, DT))
    law = LearningLaw(side, (design_low_pass(CUTOFF, DT),) * 3, TimeShift(GAIN, shift, DT))
    motion = build_way()
    done = learn(Carts(friction, seed), motion, law, CHANGES)
    change = np.diff(done.corrections, axis=0)
    f = np.fft.rfftfreq(8 * motion.n, DT)
    power = np.abs(np.fft.rfft(change, n=8 * motion.n, axis=1)) ** 2
    picture = compute_frequency_condition(law, f[1:-1])
    assert picture is not None
    expected = (picture.left / picture.bound) ** 2
    predicted, measured = [], []
    for low, high in BANDS:
        inside = (f >= low) & (f < high)
        weight = power[:-1, inside]  # each frequency counts as much as there is of it
        predicted.append(np.sqrt(np.sum(weight * expected[inside[1:-1]]) / np.sum(weight)))
        measured.append(np.sqrt(np.sum(power[1:, inside]) / np.sum(weight)))
    size = np.sum(change**2, axis=1)
    whole = np.sqrt(np.sum(size[1:], axis=0) / np.sum(size[:-1], axis=0))
    singular = max(analyse_convergence(law, motion).singular)
    return Rates(np.array(predicted), np.array(measured), singular, float(whole.max()), done)


def print_rates(seeds: int) -> None:
    """Print a row a band, without friction and with it: mean over seeds, and the least and largest measured."""
    for friction in (False, True):
        found = [measure_rates(friction, seed) for seed in range(seeds)]
        print(
            f"\nfriction {friction}: sigma {max(r.singular for r in found):.3f}, whole {max(r.whole for r in found):.3f}"
        )
        for k, (low, high) in enumerate(BANDS):
            measured = [r.measured[k] for r in found]
            print(f"| {low:g} to {high:g} Hz | {np.mean([r.predicted[k] for r in found]):.3f} | {np.mean(measured):.3f} "
                  f"({min(measured):.3f} to {max(measured):.3f}) |")  # fmt: skip
