"""Figures 6.11 to 6.13 and the M-D-K fit: the robot without wrist, pushed and watched by a laser tracker, or shaken by cart 3."""

from dataclasses import dataclass

import numpy as np

from tau_dyn.modes import Mode, Record, RefinedModel, compress_subspace_data, refine
from tau_dyn.modes.mechanical import Mechanical, SecondOrder, fit_mechanical
from tau_dyn.modes.methods import decompose_pulse_tests
from tau_dyn.modes.state_space import simulate
from tau_dyn.simulate import VibrationSensors, push_log, simulate_vibration_log
from thesis_6_3_parts.matrices import PRINTED, Character, judge_character, solve_unconstrained
from thesis_6_3_parts.printed import ORDER_TRACKER, ORDER_VISION
from thesis_6_3_parts.robots import AXES, fit_percent, record, without_wrist

IMPULSE = 5.0  # N s
VISION_NOISE = 2e-5  # m, assumed
SINES = np.array([1.1, 2.3, 3.7, 5.3, 7.1, 9.7, 11.9, 14.3, 17.1])  # Hz


@dataclass(frozen=True, eq=False)
class TrackerModel:
    """A model of some directions from pushes, and how it simulates pushes it was not fitted on."""

    axes: str
    refined: RefinedModel
    held_out: list[Record]
    simulated: list[np.ndarray]
    fit: np.ndarray


@dataclass(frozen=True, eq=False)
class Structure:
    """M, D, K by the thesis' route and by ours."""

    by_thesis: SecondOrder
    character: Character
    ours: Mechanical


@dataclass(frozen=True, eq=False)
class WristlessStudy:
    """All of it.

    `pairs` holds M, D, K from two directions at a time, `cart3` the modes of models of rising order from cart 3 alone.
    """

    full: TrackerModel
    two: TrackerModel
    pairs: dict[str, Structure]
    ours_full: Mechanical
    printed: Character
    cart3: dict[int, tuple[tuple[Mode, ...], np.ndarray]]
    compliance: np.ndarray  # (3, 3) m/N, the truth


def pushed(axes: str, seed: int) -> list[Record]:
    """Return one record a direction, as deviations from rest."""
    near, records = without_wrist(), []
    for k, axis in enumerate(axes):
        sensors = VibrationSensors.laser_tracker()
        log = push_log(near, axis, duration=3, impulse=IMPULSE, sensors=sensors, seed=seed + k)
        u, y = (np.column_stack([log.channels[f"{s}{a}_tool"] for a in axes]) for s in ("f", ""))
        rest = near.tool_position[[AXES.index(a) for a in axes]]
        names = tuple(f"f{a}_tool" for a in axes), tuple(f"{a}_tool" for a in axes)
        records.append(Record(u, y - rest, log.dt, *names, log.name))
    return records


def tracker_model(axes: str, order: int, seed: int) -> TrackerModel:
    train, test = pushed(axes, seed), pushed(axes, seed + 100)
    refined = refine(decompose_pulse_tests(train).model(order, None), train, direct=False)
    simulated = [simulate(refined.model, r, np.zeros(order)) for r in test]
    return TrackerModel(
        axes, refined, test, simulated, fit_percent(np.vstack([r.y for r in test]), np.vstack(simulated))
    )


def structure(refined: RefinedModel) -> Structure:
    by_thesis = solve_unconstrained(refined.model)
    return Structure(by_thesis, judge_character(by_thesis), fit_mechanical(refined))


def cart_3(seed: int) -> Record:
    """Cart 3 moves by overlaid sines of 2 mm in all; the others stand still; a camera watches at 250 Hz."""
    near, t = without_wrist(), np.arange(15_000) * 0.004
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(SINES))
    reference = np.zeros((len(t), 3))
    reference[:, 2] = 2e-3 / len(SINES) * np.sin(2 * np.pi * np.outer(t, SINES) + phase).sum(axis=1)
    sensors = VibrationSensors(1e-6, VISION_NOISE, accelerometer_hz=None)
    log = simulate_vibration_log(near, reference, np.zeros_like(reference), 0.004, sensors=sensors, seed=seed)
    return record(log, ["q_cart3"], [f"{a}_tool" for a in AXES])


def study(seed: int) -> WristlessStudy:
    full = tracker_model("xyz", ORDER_TRACKER, seed)
    two = {axes: tracker_model(axes, ORDER_VISION, seed) for axes in ("xy", "xz", "yz")}
    pairs = {axes: structure(model.refined) for axes, model in two.items()}
    cart3, data = {}, cart_3(seed)
    factors = compress_subspace_data([data])
    for order in (ORDER_VISION, 6, 8):
        refined = refine(factors.model(order), [data])
        cart3[order] = refined.modes, fit_percent(data.y, simulate(refined.model, data))
    return WristlessStudy(
        full,
        two["xy"],
        pairs,
        fit_mechanical(full.refined),
        judge_character(PRINTED),
        cart3,
        without_wrist().compliance(),
    )
