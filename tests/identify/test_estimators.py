"""Estimators at the statistical limit: unbiased where encoder noise sits in the columns, where feedback answers it, and honest.

The drive here is stepped by this file's own few lines, so that nothing of the simulator is tested by itself.
"""

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.estimate import solve_least_squares
from tau_dyn.identify import build_model, build_regression, choose_preparation, identify
from tau_dyn.identify.estimators import Estimator, is_residual_white
from tau_dyn.identify.full_rate import estimate_full_rate
from tau_dyn.log import Log

SEEDS = 10
MASS, FORCE, ENCODER = 90.0, 2.0, 10e-6
FRICTION = {"coulomb_pos": 20.0, "coulomb_neg": 21.0, "viscous_pos": 160.0, "viscous_neg": 240.0}
RATE = 1000.0


def drive(seed: int, *, feedback: bool, encoder: float = ENCODER, force: float = FORCE, seconds: float = 8.0) -> Log:
    """Return the log of a drive under a cascade of 15 Hz and 4 Hz that reads its encoder, or the true position."""
    rng, n, dt = np.random.default_rng([5, seed]), int(seconds * RATE), 1 / RATE
    t = np.arange(n, dtype=np.float64) * dt
    start = np.sin(np.pi / 2 * np.minimum(t, 1)) ** 2
    reference = start * (0.12 * np.sin(2 * np.pi * 0.9 * t) + 0.02 * np.sin(2 * np.pi * 2.3 * t))
    noise = encoder * rng.normal(size=n)
    q, tau = np.zeros(n), np.zeros(n)
    x, w, before = reference[0], 0.0, (reference[0], reference[0])
    for k in range(n):
        q[k], read = x, x + noise[k] * feedback
        speed = (read - before[0]) / (2 * dt)
        wish = 25 * (reference[k] - read) + (reference[k] - reference[k - 2]) / (2 * dt) * (k > 1)
        tau[k] = MASS * 2 * np.pi * 15 * (wish - speed)
        before = (before[1], read)
        side = "pos" if w > 0 or (w == 0 and tau[k] > 0) else "neg"
        sign, viscous = (1.0 if side == "pos" else -1.0), FRICTION[f"viscous_{side}"] * dt / (2 * MASS)
        pull = tau[k] - sign * FRICTION[f"coulomb_{side}"]
        new = ((1 - viscous) * w + dt * pull / MASS) / (1 + viscous)  # friction at the mean of both half steps
        w = new if new * sign > 0 else 0.0
        x = x + dt * w
    channels = {"q_axis": q + noise, "tau_axis": tau + force * rng.normal(size=n), "q_ref_axis": reference}
    return Log(t, channels, f"drive{seed}")


def z_of(estimate) -> np.ndarray:
    """Return how many standard errors each base parameter is off (r,)."""
    truth = {"carriage_link.mass": MASS} | {f"axis.{k}": x for k, x in FRICTION.items()}
    names = [estimate.base.names[k] for k in estimate.base.kept]
    return (estimate.beta_plain - np.array([truth[n] for n in names])) / estimate.stderr


def widened(model, log):
    """Return filters of 80 and 100 Hz, as one uses them who does not look at the noise."""
    chosen = choose_preparation(model.robot, [log])
    return replace(chosen, position_cutoff_hz=0.1 * RATE, force_cutoff_hz=0.08 * RATE, rate_hz=0.2 * RATE)


@pytest.fixture(scope="module")
def model(axis):
    """A drive with asymmetric friction, at nominal values."""
    return build_model(axis, "asymmetric")


@pytest.fixture(scope="module")
def trials(model):
    """Return the z of each estimator (seeds, parameters), by feedback and estimator."""
    found: dict = {}
    for feedback in (False, True):
        for seed in range(SEEDS):
            log = drive(seed, feedback=feedback)
            first = solve_least_squares(build_regression(model, [log]))
            plain = solve_least_squares(build_regression(model, [log], preparation=widened(model, log)))
            results = {"wls": first, "plain": plain}
            results |= {kind: estimate_full_rate(model, [log], first, kind).estimate for kind in ("ml", "iv")}
            for kind, e in results.items():
                found.setdefault((feedback, kind), []).append(z_of(e))
    return {key: np.array(z) for key, z in found.items()}


def test_plain_least_squares_is_biased_by_encoder_noise(trials):
    """Acceleration noise in the mass' own column pulls the mass towards zero, by more than three standard errors."""
    for feedback in (False, True):
        assert trials[feedback, "plain"][:, 0].mean() < -3


@pytest.mark.parametrize(("feedback", "kind"), [(False, "ml"), (False, "iv"), (True, "iv")])
def test_instruments_take_the_bias_out(trials, feedback, kind):
    """The mean error of ten runs is chance for every parameter, far below one standard error of one run."""
    assert np.max(np.abs(trials[feedback, kind].mean(axis=0))) < 3.3 / np.sqrt(SEEDS)


def test_intervals_are_honest(trials):
    """The rms of z over 50 numbers is one, give or take what the scatter of ten related runs allows."""
    for key in ((False, "ml"), (False, "iv"), (True, "iv")):
        assert 0.75 < np.sqrt(np.mean(trials[key] ** 2)) < 1.25, key


def test_ml_needs_no_reference_and_iv_says_that_it_does(model):
    """Without `q_ref`, ml answers and iv names the log and the column."""
    log = drive(0, feedback=False)
    bare = Log(log.t, {k: x for k, x in log.channels.items() if "ref" not in k}, "bare.csv")
    first = solve_least_squares(build_regression(model, [bare]))
    assert abs(z_of(estimate_full_rate(model, [bare], first, "ml").estimate)[0]) < 4
    with raises_code("bad_option", "bare.csv", "q_ref"):
        Estimator("iv", model, [bare])


def test_a_reference_that_is_a_measurement_is_refused(model):
    """Instruments as noisy as the columns would bring the bias back."""
    log = drive(0, feedback=False)
    copied = log.with_channels(q_ref_axis=log.channels["q_axis"])
    with raises_code("bad_option"):
        Estimator("iv", model, [copied])


def test_an_unknown_estimator_is_refused(model):
    """The sentence lists those that there are."""
    with raises_code("bad_option"):
        Estimator("magic", model, [])


def test_auto_stays_with_least_squares_where_the_model_is_incomplete(axis):
    """A ripple that the model lacks makes the whitened residual coloured; auto then changes nothing at all."""
    log = drive(1, feedback=False, encoder=1e-6)
    ripple = log.with_channels(
        tau_axis=log.channels["tau_axis"] + 6 * np.sin(2 * np.pi * log.channels["q_axis"] / 0.03)
    )
    plain, auto = (identify(axis, ripple, estimator=kind) for kind in ("wls", "auto"))
    assert auto.estimate.estimator == "wls"
    assert np.array_equal(auto.estimate.beta, plain.estimate.beta)


def test_auto_is_never_worse_on_a_log_without_noise(axis):
    """Where there is no noise to gain from, auto is as close to the truth as least squares."""
    log = drive(1, feedback=False, encoder=0.0, force=0.0)
    truth = {"carriage_link.mass": MASS} | {f"axis.{k}": x for k, x in FRICTION.items()}
    errors = []
    for kind in ("wls", "auto"):
        values = {p.name: p.value for p in identify(axis, log, estimator=kind).parameters}
        errors.append(max(abs(values[n] / x - 1) for n, x in truth.items()))
    assert errors[1] <= errors[0] * 1.01


def test_auto_takes_instruments_where_the_noise_explains_the_residual(axis):
    """On a noisy log of a complete model, auto answers with iv, more precisely than least squares says of itself."""
    log = drive(2, feedback=True)
    plain, auto = (identify(axis, log, estimator=kind).estimate for kind in ("wls", "auto"))
    assert auto.estimator == "iv"
    assert np.mean(np.diag(auto.cov) / np.diag(plain.cov)) < 1


def test_outliers_do_not_move_the_robust_estimate(model):
    """One force sample in a hundred off by 150 N: least squares' error grows by half or more, the robust one stays honest."""
    z, sizes = [], []
    for seed in range(SEEDS):
        log = drive(seed, feedback=False, encoder=2e-6)
        rng = np.random.default_rng([6, seed])
        tau = log.channels["tau_axis"]
        wild = tau + 150 * (rng.random(tau.shape) < 0.01) * rng.choice([-1, 1], tau.shape)
        spoilt = log.with_channels(tau_axis=wild)
        first = solve_least_squares(build_regression(model, [spoilt]))
        clean = solve_least_squares(build_regression(model, [log]))
        robust = estimate_full_rate(model, [spoilt], first, "robust").estimate
        z.append(z_of(robust))
        sizes.append([np.mean(e.stderr / clean.stderr) for e in (first, robust)])
    assert np.max(np.abs(np.mean(z, axis=0))) < 3.3 / np.sqrt(SEEDS)
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.25
    plain, robust = np.mean(sizes, axis=0)
    assert plain > 1.5 * robust


def test_the_whitened_residual_is_white_only_if_the_noise_is_as_assumed(model):
    """Force noise with memory is told from white force noise."""
    log = drive(3, feedback=False)
    assert is_residual_white(refined(model, log))
    rng, tau = np.random.default_rng(7), np.array(log.channels["tau_axis"])
    wander = np.convolve(rng.normal(size=len(tau)), np.ones(400) / 4, "same")
    assert not is_residual_white(refined(model, log.with_channels(tau_axis=tau + wander)))


def refined(model, log):
    """Return the maximum-likelihood fit of one log."""
    return estimate_full_rate(model, [log], solve_least_squares(build_regression(model, [log])), "ml")


def test_what_was_measured_beforehand_counts(axis):
    """A mass known to a gram, a tenth of what the log tells, stays there and is reported as certain as that."""
    from tau_dyn.identify import Choices

    log = drive(4, feedback=False)
    found = identify(axis, log, choices=Choices(fix=("carriage_link.mass=90+-0.001",)), estimator="ml")
    mass = found.parameters["carriage_link.mass"]
    assert abs(mass.value - 90) < 0.003
    assert mass.stderr == pytest.approx(0.001, rel=0.1)


def test_a_gain_scales_forces_and_its_doubt_is_carried(axis):
    """Forces logged ten percent too small, given a gain of 1.1 +- 2 %: the true mass, known to 2 %."""
    from tau_dyn.identify import Choices

    log = drive(4, feedback=False)
    small = log.with_channels(tau_axis=log.channels["tau_axis"] / 1.1)
    found = identify(axis, small, choices=Choices(fix=("axis.drive_gain=1.1+-0.022",)), estimator="ml")
    mass = found.parameters["carriage_link.mass"]
    assert mass.value == pytest.approx(MASS, rel=2e-3)
    assert mass.stderr == pytest.approx(0.02 * MASS, rel=0.1)
