"""Short and broken logs: diagnosed as far as their independent information goes, refused with the experiment below that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.diagnose import diagnose
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot

RATE_HZ = 200.0


def made(duration: float, seed: int = 3, stribeck: float = 0.0) -> Log:
    """Return a log of a 90 kg axis [s] with Coulomb and viscous friction, and a Stribeck peak [N] where asked for."""
    t, rng = np.arange(0, duration, 1 / RATE_HZ), np.random.default_rng(seed)
    w = 2 * np.pi * np.array([0.3, 0.7, 1.1])
    phase, size = rng.uniform(0, 6, 3), 0.08 / w
    angle = np.outer(t, w) + phase
    q = (size * np.sin(angle)).sum(axis=1)
    v = (size * w * np.cos(angle)).sum(axis=1)
    a = -(size * w**2 * np.sin(angle)).sum(axis=1)
    hidden = stribeck * np.exp(-((v / 0.03) ** 2)) * np.sign(v)
    tau = 90.0 * a + 20.0 * np.sign(v) + 220.0 * v + hidden + rng.standard_normal(len(t))
    return Log(t, {"q_axis": np.round(q / 1e-6) * 1e-6, "tau_axis": tau}, "made.csv")


@pytest.fixture(scope="module")
def axis():
    return load_robot("linear_axis")


def test_twenty_seconds_are_diagnosed_and_clean_ones_name_nothing(axis) -> None:
    """A clean log of 20 s has no confirmed cause, and says from where on each would have been seen."""
    found = diagnose(axis, made(20.0))
    assert not [f for f in found.findings if f.status == "confirmed"]
    assert found.limits and not [w for w in found.warnings if get_code(w) == "short_log"]


def test_a_strong_cause_is_named_in_twenty_seconds(axis) -> None:
    """A Stribeck peak of 15 N in noise of 1 N stands out of 20 s."""
    found = diagnose(axis, made(20.0, stribeck=15.0))
    assert [(f.cause, f.joints) for f in found.findings if f.status == "confirmed"] == [("stribeck", ("axis",))]


def test_less_information_than_unknowns_cannot_answer(axis) -> None:
    """Two seconds hold fewer independent values than a mass and four friction coefficients, however densely sampled."""
    with raises_code("too_little_data", "5") as fault:
        diagnose(axis, made(2.0))
    assert "half a minute" in fault.value.experiment


def test_a_broken_log_is_diagnosed_from_its_long_pieces(axis) -> None:
    """Pieces of 50 ms are left out and said; the errors carry both all samples and the share used."""
    log = made(30.0)
    lost = (log.t % 6.0 > 5.7) & (log.t % 6.0 < 5.8) | (log.t % 6.0 > 5.85)
    broken = replace(log, t=log.t[~lost], channels={key: x[~lost] for key, x in log.channels.items()})
    found = diagnose(axis, broken)
    (text,) = [str(w) for w in found.warnings if get_code(w) == "short_log"]
    assert "5 of 10 pieces" in text
    told = found.to_dict()
    for model in ("baseline", "extended", "noise_floor"):
        assert told[model]["all_samples"]["relative_error_percent"] > 0
        assert 0 < told[model]["used_share_per_joint"]["axis"] <= 1
