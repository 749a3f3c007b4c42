"""What stands in the end: causes that every part of the data bears out."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from tau_dyn.diagnose import diagnose
from tau_dyn.effects import Delay, PlausibleRange, QuadraticDrag, Stribeck, build_friction_model
from tau_dyn.evidence import Gain, plausibility
from tau_dyn.evidence.claims import recommend, select_confirmed, select_supported
from tau_dyn.evidence.confirmation import Confirmation, confirm
from tau_dyn.evidence.measurements import TEST, TRAIN, VALIDATION
from tau_dyn.evidence.noise_only_bootstrap import NoiseOnlyBootstrap
from tau_dyn.evidence.plausibility import find_inconsistent
from tau_dyn.evidence.stepwise_selection import select_causes
from tau_dyn.evidence.validation import ConfirmationResults, confirm_cause, confirm_within_training
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.robot import load_robot
from tau_dyn.simulate import Sensors, build_named_motion, simulate


@pytest.mark.parametrize(("last", "within", "stands"), [(1.0, False, True), (-1.0, False, False), (-1.0, True, False)])
def test_the_last_part_has_a_veto(make, last: float, within: bool, stands: bool):
    """A drag that pushes where the gain is measured, and brakes everywhere else, is found and confirmed, and does not stand.

    Nor does it where blocks of the training logs confirmed it: what is confirmed has a gain above zero.
    """
    rng = np.random.default_rng(5)

    def hidden(motion):
        own = np.where(make.turns(len(motion.t)) == TEST, last, 1.0)
        return 90 * own[:, None] * motion.v * np.abs(motion.v)

    channel = make.bench(rng, hidden, n=8000, causes=(QuadraticDrag,))
    selection = select_causes(channel, rng, lambda step: None)
    tests = [replace(confirm_cause(selection, one), within=within) for one in selection.found]
    claims = select_confirmed(selection, tests)
    assert [one.candidate.cause for one in claims.kept] == ["quadratic_drag"]
    stood, waterfall = select_supported(selection, claims, rng)
    assert stood.kept == (claims.kept if stands else [])
    assert len(waterfall.gains) == len(stood.kept) and bool(stood.why_not[0]) != stands


def stand(channel, rng):
    """Return the claims that stand of one cause, and the recommendation."""
    selection = select_causes(channel, rng, lambda step: None)
    claims = select_confirmed(selection, [confirm_cause(selection, one) for one in selection.found])
    claims, waterfall = select_supported(selection, claims, rng)
    return claims, recommend(selection, claims, waterfall, rng)


def drag(motion):
    """Return the force (N, 1) of a drag of 90 N/(m/s)^2."""
    return 90 * motion.v * np.abs(motion.v)


def test_an_amplitude_that_no_machine_has_is_not_confirmed(make, rng, monkeypatch):
    """A drag three times beyond its plausible range is found, and suspected with the range as the reason."""
    channel = make.bench(rng, drag, n=8000, causes=(QuadraticDrag,))
    assert stand(channel, rng)[0].why_not == ("",)
    monkeypatch.setattr(QuadraticDrag, "plausible", (PlausibleRange("quadratic_drag", 0.0, 30.0),))
    claims, recommendation = stand(channel, rng)
    assert "plausible" in claims.why_not[0] and recommendation.choice == "refitted"


def test_what_no_force_is_measured_to_is_no_cause(make, rng, monkeypatch):
    """A drag whose effect is below the accuracy of force sensors is suspected for that."""
    monkeypatch.setattr(plausibility, "MIN_FORCE_SHARE", 1.0)
    claims, recommendation = stand(make.bench(rng, drag, n=8000, causes=(QuadraticDrag,)), rng)
    assert "sensor accuracy" in claims.why_not[0] and recommendation.choice == "refitted"


def test_a_setting_at_the_edge_of_its_grid_is_not_confirmed(make, rng, monkeypatch):
    """A friction peak narrower than the narrowest that is tried says that the grid ends, not where the peak does."""

    def peak(motion):
        return 30 * np.sign(motion.v) * np.exp(-np.abs(motion.v) / 0.05)

    channel = make.bench(rng, peak, n=8000, causes=(Stribeck,))
    assert stand(channel, rng)[0].why_not == ("",)
    grid = [{"speed": x, "power": 1.0} for x in (0.1, 0.15, 0.2)]
    monkeypatch.setattr(Stribeck, "grid", classmethod(lambda cls, scene, joints: grid))
    assert "edge" in stand(channel, rng)[0].why_not[0]


def test_one_recording_has_one_delay():
    """Delays of 1.5 and 7 ms on two joints of one log are not a clock's; 8.0 and 7.9 +- 0.1 ms may be.

    Two that are read in turn differ by up to a sample: 8.0 and 9.0 ms are one delay at 4 ms a sample, and two at 0.1 ms.
    """
    effects = [Delay((joint,), ("N m",)) for joint in ("one", "two")]

    def inconsistent(*values: float, step_s: float = 1e-4) -> str:
        rows = zip(("one", "two"), values, strict=True)
        found = Parameters(Parameter(f"{j}.delay", x, "s", stderr=1e-4) for j, x in rows)
        return find_inconsistent(effects, found, step_s)

    assert "one 1.5 ms" in inconsistent(1.5e-3, 7e-3) and not inconsistent(8.0e-3, 7.9e-3)
    assert inconsistent(8e-3, 9e-3) and not inconsistent(8e-3, 9e-3, step_s=4e-3)
    assert not find_inconsistent(effects[:1], Parameters([Parameter("one.delay", 7e-3, "s", stderr=1e-4)]), 1e-4)


def test_a_gain_that_may_be_zero_confirms_nothing(make, rng, monkeypatch):
    """The interval of the gain decides, not its value."""
    channel = make.bench(rng, drag, n=8000, causes=(QuadraticDrag,))
    module = import_module("tau_dyn.evidence.claims")  # `tau_dyn.diagnose` itself is the function
    monkeypatch.setattr(module, "compute_gain", lambda *_: Gain(10.0, 9.0, 10.0, (-0.1, 20.0)))
    claims, _ = stand(channel, rng)
    assert "gain" in claims.why_not[0] and claims.kept == []


@pytest.mark.parametrize(("last", "stands"), [(1.0, True), (-1.0, False)])
def test_where_few_last_samples_leave_a_gain_open_the_confirming_part_counts_too(make, last: float, stands: bool):
    """A drag whose gain three seconds cannot tell is confirmed by these and the confirming part, unless it pushes in the last."""
    rng = np.random.default_rng(5)
    turns = make.turns(8000)
    turns[(turns == TEST) & (np.arange(8000) > 1000)] = -1

    def hidden(motion):
        return 40 * np.where(turns == TEST, last, 1.0)[:, None] * motion.v * np.abs(motion.v)

    channel = make.bench(rng, hidden, n=8000, causes=(QuadraticDrag,))
    channel = replace(channel, parts=(turns,))
    selection = select_causes(channel, rng, lambda step: None)
    (one,) = selection.found
    shown = confirm(
        selection.null_model, selection.columns(one.candidate.effects), (), (TEST,), fitted_on=(TRAIN, VALIDATION)
    )
    assert shown.leaves_gain_open or not stands
    assert bool(stand(channel, rng)[0].kept) is stands


def test_the_extended_model_is_recommended_where_the_error_falls(make, rng):
    """A drag that all of the data show makes the extended model the better one; without any the refitted one stays."""
    assert stand(make.bench(rng, drag, n=8000, causes=(QuadraticDrag,)), rng)[1].choice == "extended"
    assert stand(make.bench(rng, n=8000, causes=(QuadraticDrag,)), rng)[1].choice == "refitted"


def test_an_output_that_loses_in_the_reported_errors_forbids_the_extended_model(make, rng):
    """The causes are searched in a wider band, but the recommendation is also true of the errors that are printed."""
    channel = make.bench(rng, drag, n=8000, causes=(QuadraticDrag,))
    selection = select_causes(channel, rng, lambda step: None)
    claims = select_confirmed(selection, [confirm_cause(selection, one) for one in selection.found])
    claims, waterfall = select_supported(selection, claims, rng)
    first, *_, last = waterfall.fits
    poor = replace(last, other=replace(first, residuals=[1.2 * e for e in first.residuals]))
    found = recommend(selection, claims, waterfall._replace(fits=[first, poor]), rng)
    assert found.choice == "refitted" and "x by 20 %" in found.why


def test_held_out_logs_of_another_machine_are_told(make, rng):
    """Where held-out errors are many times the training errors neither model is that of the held-out machine."""
    motions = tuple(make.moving(rng, ("x",), 4000) for _ in range(2))
    foreign = iter((0.0, 400.0))

    def carried(motion):
        return next(foreign) * np.sin(3 * motion.q)

    channel = make.bench(rng, carried, motions=motions, causes=(QuadraticDrag,))
    turns = np.arange(4000) // 100 % 2 + 1
    channel = replace(channel, parts=(np.zeros(4000, int), turns))
    recommendation = stand(channel, rng)[1]
    assert recommendation.choice == "neither" and "x" in recommendation.why
    assert [get_code(warning) for warning in recommendation.warnings] == ["holdout_differs"]


def test_without_held_out_logs_there_is_no_second_search(make, rng):
    """Blocks that take turns have heard all that the logs can say: what is silent there stays as it is, and nothing is made."""
    channel = make.bench(rng, causes=(QuadraticDrag,))
    selection = select_causes(channel, rng, lambda step: None)
    tests = ConfirmationResults((Confirmation(0.1, 0.9, 0.4),), None)
    assert tests.causes[0].is_inconclusive
    never = NoiseOnlyBootstrap(lambda: pytest.fail("noise was made for a search that cannot say anything"))
    assert confirm_within_training(selection, tests, 0.1, rng, never) is tests


def test_noise_is_made_once_and_divided_as_a_second_search_is(make, rng):
    """The second search looks at the same noise-only logs, in its own blocks."""
    channel, made = make.bench(rng), []
    noise = NoiseOnlyBootstrap(lambda: made.append(1) or [channel])
    inner = noise.within((np.full(len(channel.runs[0].t), -1),))
    assert np.all(inner.channels[0].parts[0] == -1) and noise.channels == [channel]
    assert len(made) == 1 and np.any(channel.parts[0] != -1)


def test_a_log_that_is_not_what_it_claims_confirms_nothing():
    """Forces of the wrong sign name no cause, whatever fits them, and leave neither model to use."""
    axis = load_robot("linear_axis")
    model = Model.of(axis, build_friction_model("asymmetric", axis.actuated, axis.force_units)).with_values(
        {
            f"axis.{key}": x
            for key, x in (("coulomb_pos", 20), ("coulomb_neg", 21), ("viscous_pos", 200), ("viscous_neg", 210))
        }
    )
    sensors = Sensors(encoder_noise=1e-6, force_noise=1.0, log_rate_hz=250.0)
    log = simulate(model, build_named_motion("fourier", model, 30.0, 2), sensors=sensors, seed=2)
    turned = replace(log, channels={**log.channels, "tau_axis": -log.channels["tau_axis"]})
    found = diagnose(axis, [turned])
    assert found.verdict == "cannot_tell" and found.recommendation == "neither" and found.exit_status == 3
    assert not any(f.status in ("confirmed", "parameter") for f in found.findings)
    assert "sign_reversed" in found.to_dict()["warning_codes"]
