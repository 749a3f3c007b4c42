"""The experiments' motions, given by the tool's path: sums of sines, a small circle, strokes at constant speed.

`C` is the centre of all motions [m]; terms are (amplitude [m], frequency [Hz], phase) of x, y and z.
"""

import numpy as np

from tau_dyn.mechanism import GantryTauMechanism
from tau_dyn.simulate import Trajectory, concatenate
from tau_dyn.simulate.trajectory import Segment, build_speed_profile, compute_ramp_time

C = (1.5, -0.65, 0.62)
WELL = (  # moves all three axes, and at frequencies of their own
    ((0.20, 0.23, 0.0), (0.06, 0.53, 1.0), (0.02, 1.13, 2.0)),
    ((0.15, 0.19, 0.5), (0.04, 0.61, 1.7), (0.018, 1.31, 0.3)),
    ((0.15, 0.27, 1.1), (0.04, 0.67, 0.2), (0.018, 1.23, 2.5)),
)
SIDEWAYS_FAST = (((0.28, 0.3, 0.0), (0.035, 0.9, 1.0)), ((0.08, 0.45, 0.5),), ((0.08, 0.5715, 1.1),))
SIDEWAYS_SLOW = (((0.28, 0.3, 0.0), (0.035, 0.9, 1.0)), ((0.05, 0.11, 0.5),), ((0.05, 0.1397, 1.1),))
ALONG_X = (((0.35, 0.3, 0.0), (0.04375, 0.9, 1.0)), ((0.02, 0.11, 0.5),), ((0.02, 0.1397, 1.1),))
SPEEDS = (0.02, 0.04, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # m/s
STROKE, LONGEST, ACCELERATION = 1.0, 4.0, 6.0  # m with its ramps, s of constant speed, m/s^2 peak
RISE = 2.0  # s in which a motion fades in and out
RATE = 500.0  # Hz
CIRCLE = (0.01, 12.0, 2)  # m, s a turn, turns


def cart_positions(mechanism: GantryTauMechanism, tool: np.ndarray) -> np.ndarray:
    """Return cart positions (N, 3) [m] for tool positions (N, 3), nan out of reach; rods point along the guideways."""
    reach = tool[:, None, :] - mechanism.origin
    along = np.einsum("nij,ij->ni", reach, mechanism.direction)
    across2 = np.sum(reach**2, axis=2) - along**2
    rest = mechanism.length**2 - across2
    return along - np.sqrt(np.where(rest > 0, rest, np.nan))


def fast_and_slow(mechanism: GantryTauMechanism, terms: tuple, name: str, duration: float = 40.0) -> Trajectory:
    """Return sines about `C`, and the same at a sixth of their frequencies, each of this duration [s]."""
    t = np.arange(round(duration * RATE) + 1) / RATE
    pieces = [_through(mechanism, t, C + _fade(t)[:, None] * _sines(t / k, terms), name) for k in (1.0, 6.0)]
    return concatenate(pieces, rate_hz=RATE, name=name)


def small_circle(mechanism: GantryTauMechanism) -> Trajectory:
    """Return slow turns in the y-z plane; the radius grows and shrinks in `RISE` seconds at the ends."""
    radius, period, turns = CIRCLE
    t = np.arange(round((period * turns + 2 * RISE) * RATE) + 1) / RATE
    angle = 2 * np.pi * (t - RISE) / period
    tool = C + (radius * _fade(t))[:, None] * np.column_stack([0 * t, np.cos(angle), np.sin(angle)])
    return _through(mechanism, t, tool, "1 cm circle")


def strokes(
    mechanism: GantryTauMechanism, position: tuple[float, float], name: str, speeds: tuple[float, ...] = SPEEDS
) -> tuple[Trajectory, np.ndarray]:
    """Return all carts at each of these speeds [m/s], there and back, with the tool at (y, z) [m], and when speed is steady."""
    home = mechanism.robot.home
    q = cart_positions(mechanism, np.array([[0.0, *position]]))[0]
    q = q - 0.5 * np.max(q - home) - 0.5 * np.min(q - home)  # carts as near the middle of their travel as they can be
    segments = []
    for speed in speeds:
        ramp = compute_ramp_time(speed, ACCELERATION)
        steady = min(LONGEST, (STROKE - ramp * speed) / speed)
        for way in (speed, -speed):
            segments += [Segment(ramp, 0, way), Segment(steady, way, way), Segment(ramp, way, 0), Segment(0.2, 0, 0)]
    t = np.arange(0.0, sum(s.duration for s in segments), 1 / RATE)
    path = build_speed_profile(t, segments)
    middle = 0.5 * (path.q.max() + path.q.min())
    begins = np.cumsum([0.0, *(s.duration for s in segments[:-1])])
    steady = np.zeros(len(t), bool)
    for s, begin in zip(segments, begins, strict=True):
        if s.start == s.end != 0:
            steady |= (t > begin + 0.1) & (t < begin + s.duration - 0.02)  # 0.1 s for the feedback to settle
    dq, v, a = (np.tile(x[:, None], 3) for x in (path.q - middle, path.v, path.a))
    return Trajectory(mechanism.robot.actuated, t, q + dq, v, a, name), steady


def _sines(t: np.ndarray, terms: tuple) -> np.ndarray:
    return np.column_stack([sum(A * np.sin(2 * np.pi * f * t + phase) for A, f, phase in axis) for axis in terms])


def _fade(t: np.ndarray) -> np.ndarray:
    s = np.clip(np.minimum(t, t[-1] - t) / RISE, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _through(mechanism: GantryTauMechanism, t: np.ndarray, tool: np.ndarray, name: str) -> Trajectory:
    return Trajectory.through(mechanism.robot.actuated, t, cart_positions(mechanism, tool), name)
