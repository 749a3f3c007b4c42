"""`identify` reports a force that changes inside a log, and joints whose force it misses."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.identify import identify
from tau_dyn.message_codes import get_code
from tau_dyn.render.kinds.identification import describe_verdict
from tau_dyn.simulate import build_named_motion


def scale_force(log, make, time_s: float, factor: float):
    """Return the drive's log with its force times a factor after a time."""
    return make.changed(log, tau_axis=np.where(log.t > time_s, factor, 1.0) * log.joint("tau", ["axis"])[:, 0])


def test_a_gain_that_falls_in_a_training_log_is_reported_with_its_time(axis, axis_log, make):
    """The errors of the fit are useless; the warning tells where to cut the log."""
    found = identify(axis, scale_force(axis_log, make, 12.0, 0.2), estimator="wls")
    fields = found.to_dict()
    assert fields["changes"][0]["after"] == pytest.approx(0.2, abs=0.03)
    assert fields["time_s"] == pytest.approx([12.0], abs=0.2)
    assert fields["warning_joints"] == {"changes_within_log": ["axis"], "poor_fit": ["axis"]}
    assert describe_verdict(found).level != "good"


def test_a_log_whose_sign_turns_half_way_determines_nothing_and_the_refusal_holds_the_reason(axis, axis_log, make):
    """No parameter fits both halves."""
    with pytest.raises(CannotAnswer) as refused:
        identify(axis, scale_force(axis_log, make, 12.0, -1.0), estimator="wls")
    assert "changes_within_log" in map(get_code, refused.value.warnings)


def test_a_sound_log_has_neither_a_change_nor_a_poor_fit(axis, axis_log):
    """Asymmetric friction and noise are what the model holds."""
    fields = identify(axis, axis_log, estimator="wls").to_dict()
    assert not {"changes", "time_s", "warning_joints"} & set(fields)
    assert not {"changes_within_log", "poor_fit"} & set(fields["warning_codes"])


def test_a_change_in_a_held_out_log_is_reported_with_that_log(axis, true_axis, axis_log, make):
    """Training is sound; the drive of the held-out log loses a quarter of its force half-way."""
    other = make.recorded(true_axis, build_named_motion("fourier", true_axis, 20.0, 5), force_noise=2.0, seed=7)
    held = scale_force(other, make, 9.0, 0.75)
    held = type(held)(held.t, dict(held.channels), "held.csv")
    (change,) = identify(axis, axis_log, holdout=held, estimator="wls").changes
    assert (change.log, change.kind) == ("held.csv", "gain")
    assert change.after == pytest.approx(0.75, abs=0.03)
