"""A test bench: joints whose motion, noise and hidden force are given outright, as a channel of unfiltered columns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import uniform_filter1d
from scipy.signal import lfilter

from tau_dyn.effects import Effect, JointMotion, JointwiseEffect, Motion, Scene
from tau_dyn.estimate import Autoregression, RegressionRun
from tau_dyn.evidence.channel import Channel, ColumnCache
from tau_dyn.evidence.measurements import TRAIN
from tau_dyn.evidence.null_model import NullModel
from tau_dyn.parameters import Parameter, Parameters

RATE_HZ = 50.0
SLOW = 0.02  # [m/s] below which samples do not count
GAP = 15  # samples left out between parts and around reversals, over which the noise forgets
PHI = 0.8  # of the noise, whose standard deviation is 1 N
NOISE = Autoregression(np.array([PHI]), 1.0)
KNOWN = {"mass": 20.0, "coulomb": 15.0, "viscous": 30.0, "offset": 5.0}
Force = Callable[[Motion], np.ndarray]


@dataclass(frozen=True, eq=False)
class Bench(Channel):
    """A channel whose columns are what an effect says of the motion itself."""

    motions: tuple[Motion, ...]

    def run_columns(self, effect: Effect, run: int) -> np.ndarray:
        """Return the effect's own columns."""
        return effect.columns(self.motions[run])

    def variables(self) -> list[Mapping[str, np.ndarray]]:
        """Return what `ForceChannel` would."""
        found = []
        for m in self.motions:
            row = {f"{key}_{j}": getattr(m, key)[:, k] for key in "qva" for k, j in enumerate(m.joints)}
            row["t"] = np.asarray(m.t)
            if "temperature" in m.signals:
                row |= {f"temp_{j}": m.signals["temperature"][:, k] for k, j in enumerate(m.joints)}
            found.append(row)
        return found


def moving(rng: np.random.Generator, joints: Sequence[str], n: int, size: float = 1.0) -> Motion:
    """Return sines of 0.1 to 1 Hz in every joint, about 0.3 m and 0.4 m/s at `size` 1."""
    t = np.arange(n) / RATE_HZ
    q, v, a = np.zeros((3, n, len(joints)))
    for k in range(len(joints)):
        for f in np.geomspace(0.1, 1.0, 6) * rng.uniform(0.9, 1.1, 6):
            w, phase, much = 2 * np.pi * f, rng.uniform(0, 2 * np.pi), 0.1 * size * rng.uniform(0.5, 1)
            q[:, k] += much / w * np.sin(w * t + phase)
            v[:, k] += much * np.cos(w * t + phase)
            a[:, k] -= much * w * np.sin(w * t + phase)
    return Motion.of(tuple(joints), q, v, a, t=t)


def coloured(rng: np.random.Generator, n: int, m: int) -> np.ndarray:
    """Return the bench's noise (n, m) [N]."""
    white = rng.standard_normal((n + 200, m)) * np.sqrt(1 - PHI**2)
    return lfilter([1.0], [1.0, -PHI], white, axis=0)[200:]


def taking_turns(n: int) -> np.ndarray:
    """Return parts (n,) in 4 s blocks, 3 : 1 : 1, `GAP` samples apart."""
    length = round(4 * RATE_HZ)
    out = np.array([0, 1, 0, 2, 0])[np.arange(n) // length % 5]
    return np.where(np.arange(n) % length < GAP, -1, out)


def sure(motion: Motion) -> np.ndarray:
    """Return which samples (n, m) move, and stand off from those that do not as a filter's memory would demand."""
    slow = (np.abs(motion.v) < SLOW).astype(float)
    return uniform_filter1d(slow, GAP, axis=0) < 1e-9


def baseline(motion: Motion) -> np.ndarray:
    """Return acceleration, direction, speed and one for each joint (n, m, 4 m): mass, friction and offset."""
    n, m = motion.v.shape
    W = np.zeros((n, m, 4 * m))
    for k in range(m):
        own = motion.a[:, k], motion.sign[:, k], motion.v[:, k], np.ones(n)
        W[:, k, 4 * k : 4 * k + 4] = np.column_stack(own)
    return W


def bench(
    rng: np.random.Generator,
    hidden: Force = lambda motion: np.zeros_like(motion.v),
    *,
    joints: Sequence[str] = ("x",),
    n: int = 4000,
    motions: Sequence[Motion] = (),
    parts: Callable[[int], np.ndarray] = taking_turns,
    causes: Sequence[type[Effect]] = (),
    campaigns: int = 1,
    noise: float = 1.0,
    **known: dict[str, Any],
) -> Bench:
    """Return a channel of joints with mass 20, Coulomb friction 15, viscous friction 30 and offset 5, a hidden force and noise.

    `known` changes attributes of baseline parameters, such as `x_mass={"free": False}`.
    """
    motions = tuple(motions) or (moving(rng, joints, n),)
    joints = motions[0].joints
    theta = np.tile(list(KNOWN.values()), len(joints))
    runs = []
    for k, motion in enumerate(motions):
        W = baseline(motion)
        y = W @ theta + hidden(motion) + noise * coloured(rng, *motion.v.shape)
        runs.append(RegressionRun(f"log{k}", np.asarray(motion.t), W, y, sure(motion), W, y))
    names = [(f"{j}_{what}", x) for j in joints for what, x in KNOWN.items()]
    q, v = (np.concatenate([getattr(m, key) for m in motions]) for key in "qv")
    signals = frozenset.intersection(*(frozenset(m.signals) for m in motions))
    scene = Scene(
        joints,
        ("N",) * len(joints),
        q.min(axis=0),
        q.max(axis=0),
        np.full(len(joints), SLOW),
        np.quantile(np.abs(v), 0.98, axis=0),
        20.0,
        sum(len(m.v) for m in motions) / RATE_HZ,
        signals,
        campaigns,
    )
    return Bench(
        "force",
        joints,
        ("N",) * len(joints),
        Parameters([Parameter(name, x, "1") for name, x in names]).update(known),
        tuple(runs),
        tuple(parts(len(run.t)) for run in runs),
        scene,
        tuple(causes),
        motions,
    )


def measuring(channel: Bench, y: np.ndarray) -> Bench:
    """Return the channel of one run with other measurements (n, m)."""
    return replace(channel, runs=(replace(channel.runs[0], y=y, y_all=y),))


def build_null_model(channel: Bench, *parts: int, beside: Sequence[Effect] = ()) -> NullModel:
    """Return the null_model of these parts (by default the training part) under the bench's true noise model."""
    return NullModel.of(ColumnCache(channel), parts or (TRAIN,), (NOISE,) * len(channel.outputs), beside)


class Bump(JointwiseEffect):
    """A force at one place, for its grid's bumps hardly overlap: as many independent tries as places."""

    name = "bump"
    equation = "tau += bump exp(-((q - place) / width)^2)"
    reveals = "motion through all places"
    quantities = (("bump", "F"),)
    defaults = {"place": 0.0, "width": 1.0}
    places = 8

    def per_joint(self, joint: JointMotion) -> list[np.ndarray]:
        """Return the bump."""
        return [np.exp(-(((joint.q - self.settings["place"]) / self.settings["width"]) ** 2))]

    @classmethod
    def grid(cls, scene: Scene, joints: tuple[str, ...]) -> list[dict[str, float]]:
        """Return places two widths apart."""
        k = scene.index(joints[0])
        edges = np.linspace(0.8 * scene.low[k], 0.8 * scene.high[k], cls.places + 1)
        width = float(edges[1] - edges[0]) / 2
        return [{"place": float(x), "width": width} for x in (edges[1:] + edges[:-1]) / 2]


class ManyBumps(Bump):
    """The same with many places."""

    name = "many_bumps"
    places = 40


class OneBump(Bump):
    """The same with a single place."""

    name = "one_bump"
    places = 1


@pytest.fixture(scope="session")
def make() -> SimpleNamespace:
    """The makers above, and what they make it of."""
    kinds = {"Bump": Bump, "ManyBumps": ManyBumps, "OneBump": OneBump}
    functions = {
        "bench": bench,
        "moving": moving,
        "coloured": coloured,
        "measuring": measuring,
        "null_model": build_null_model,
    }
    return SimpleNamespace(noise=NOISE, turns=taking_turns, **functions, **kinds)
