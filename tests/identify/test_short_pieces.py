"""Short and broken logs are used as far as they go, and what is left out is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raising import raises_code

from tau_dyn.identify import EXPERIMENT, count_information, identify, keep_long
from tau_dyn.identify.preparation import compute_min_samples
from tau_dyn.log import Log, compute_edge_samples, count_short_segments
from tau_dyn.message_codes import get_code
from tau_dyn.robot import load_robot

RATE_HZ = 200.0
MASS, COULOMB, VISCOUS = 90.0, 20.0, 220.0


def made(duration: float, seed: int = 0, *, moving: float = 1.0) -> Log:
    """Return a log of the linear axis [s] that moves in the first part of the time only."""
    t = np.arange(0, duration, 1 / RATE_HZ)
    s = np.minimum(t, moving * duration)
    w = 2 * np.pi * np.array([0.4, 0.9, 1.3])
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    size = 0.05 / w
    stop = 0.5 * (1 - np.tanh((t - moving * duration) / 0.05)) if moving < 1 else np.ones_like(t)
    q = (size * np.sin(np.outer(s, w) + phase)).sum(axis=1)
    v = stop * (size * w * np.cos(np.outer(s, w) + phase)).sum(axis=1)
    a = stop * -(size * w**2 * np.sin(np.outer(s, w) + phase)).sum(axis=1)
    noise = np.random.default_rng(seed + 1).standard_normal(len(t))
    tau = MASS * a + COULOMB * np.sign(v) + VISCOUS * v + noise
    q = np.round(q / 1e-6) * 1e-6
    return Log(t, {"q_axis": q, "tau_axis": tau}, f"made{seed}.csv")


def cut(log: Log, lengths: list[float], lost: float = 0.2) -> Log:
    """Return the log with samples lost after each of these times in a row [s]."""
    keep, start = np.ones(log.n_samples, bool), 0.0
    for length in lengths:
        keep[(log.t >= start + length) & (log.t < start + length + lost)] = False
        start += length + lost
    return replace(log, t=log.t[keep], channels={key: x[keep] for key, x in log.channels.items()})


def said(found, code: str) -> list[str]:
    return [str(w) for w in found.warnings if get_code(w) == code]


@pytest.fixture(scope="module")
def axis():
    return load_robot("linear_axis")


def test_a_piece_too_short_for_the_filters_is_left_out_and_the_rest_is_fitted(axis) -> None:
    """Of pieces of 0.1, 0.3 and 0.02 s beside 19 s only the long one counts, and the mass is found from it."""
    found = identify(axis, cut(made(20.0), [0.1, 0.3, 0.02]))
    first, second = said(found, "short_log")
    assert "1 piece of fewer than 10 samples" in first and "0.02 s" in first
    assert "2 of 3 pieces" in second and "0.4 of 19.4 s are left out" in second
    assert found.estimate.parameters["carriage_link.mass"].value == pytest.approx(MASS, rel=0.01)


def test_short_pieces_do_not_widen_the_filters(axis) -> None:
    """A piece of a tenth of a second resolves no band; the filters are those of the long piece alone."""
    whole, broken = (identify(axis, log).estimate.regression for log in (made(20.0), cut(made(20.0), [0.1, 0.1])))
    used = [r.preparation.force_cutoff_hz for r in (whole, broken)]
    assert used[1] == pytest.approx(used[0], rel=0.1)


def test_nothing_but_short_pieces_cannot_answer_and_says_which_length_it_takes(axis) -> None:
    """A log lost in crumbs names its longest piece and the experiment; it is not an input fault."""
    with raises_code("too_little_data", "0.1") as fault:
        identify(axis, cut(made(9.0), [0.1] * 30))
    assert fault.value.experiment == EXPERIMENT


def test_crumbs_alone_cannot_answer(axis) -> None:
    """Where every piece has fewer than 10 samples, no stretch is left at all."""
    log = cut(made(3.0), [0.04] * 13)
    assert count_short_segments(log)[0] == 13
    with raises_code("too_little_data", "made0.csv"):
        identify(axis, cut(made(3.0), [0.04] * 13))


def test_a_short_held_out_log_does_not_end_the_run(axis) -> None:
    """The fit stands; there are no held-out errors, and a warning says why."""
    found = identify(axis, made(20.0), holdout=made(0.08, 1))
    assert found.holdout is None and found.train.relative_error_percent < 5
    assert "there are no held-out errors" in said(found, "short_log")[0]


def test_a_log_of_a_few_seconds_gets_an_answer_with_wide_limits(axis) -> None:
    """Two seconds hold about as many independent values as unknowns: the mass is found, within its wider interval."""
    short, long = identify(axis, made(2.0)), identify(axis, made(30.0))
    one, other = (f.estimate.parameters["carriage_link.mass"] for f in (short, long))
    assert said(short, "short_log") and not said(long, "short_log")
    assert one.stderr > 1.5 * other.stderr  # the uncertainty of the clock is a part of both
    assert abs(one.value - MASS) < 5 * one.stderr


def test_information_grows_with_time_not_with_the_sampling_rate(axis) -> None:
    """`2 f_b T`: half of the time has half of it."""
    whole = identify(axis, made(30.0)).estimate.regression
    first = replace(whole, runs=tuple(run.window(slice(0, len(run.t) // 2)) for run in whole.runs))
    assert count_information(first, 1.0) == pytest.approx(count_information(whole, 1.0) / 2, rel=0.1)
    assert 0.5 * 2 * 30 < count_information(whole, 1.0) <= 2 * 30


def test_a_piece_counts_from_where_it_gives_a_row() -> None:
    """Both ends that the filter disturbs, and one decimated sample between them."""
    n = compute_min_samples(10.0, 200.0, 4)
    assert n > 2 * compute_edge_samples(10.0, 200.0)
    t = np.arange(n) / 200.0
    pieces = [Log(t, {}, "a"), Log(t[:-1], {}, "a")]
    kept = keep_long(pieces, 10.0, lambda rate: 4)
    assert kept.index == (0,) and "1 of 2 pieces" in kept.warnings[0]


def test_a_joint_that_rests_most_of_the_time_is_named(axis) -> None:
    """An axis that stands still for three quarters of a log is named with its share; one that moves is not."""
    rest = identify(axis, made(40.0, moving=0.25))
    (text,) = said(rest, "rests_mostly")
    assert text.startswith("axis (7") and "rests most of the time" in text
    assert not said(identify(axis, made(20.0)), "rests_mostly")


def test_the_share_used_is_told_by_joint(axis) -> None:
    """The used share of one joint is that of all, and JSON has it beside the errors over all samples."""
    found = identify(axis, made(20.0))
    told = found.to_dict()["train"]
    assert told["used_share_per_joint"] == {"axis": pytest.approx(told["used_share"])}
    assert told["used_share"] < 1 and told["all_samples"]["relative_error_percent"] > 0
