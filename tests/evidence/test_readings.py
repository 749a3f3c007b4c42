"""Acceptance of re-readings of a log: gain, good fit, agreement of both halves, and the log's own records."""

from __future__ import annotations

import numpy as np
import pytest

from tau_dyn.evidence import (
    ReadingFit,
    ReadingTest,
    compute_zero_mean_nats,
    is_factor_known,
    is_hopeless,
    is_part_missing,
    is_preferred,
    is_preferred_at_each_joint,
    is_preferred_in_each_half,
    list_aliases,
    permits_size,
    permits_speed_scale,
    search_readings,
)

SIZE = np.array([10.0, 2.0])
"""Root mean square forces of two joints [N m]."""


def fit(log_p: float, *shares: float, prior: float = 0.0) -> ReadingFit:
    """Return a fit with residuals given as shares of the joints' forces."""
    return ReadingFit(log_p, log_p, (np.array(shares) * SIZE) ** 2, prior, np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("after", "accepted"),
    [
        (fit(100.0, 0.06, 0.1), True),  # mends the second joint
        (fit(20.0, 0.06, 0.1), False),  # gains less than 30 nats
        (fit(100.0, 0.06, 0.35), False),  # leaves more than half of each joint's residual power
    ],
)
def test_a_reading_gains_30_nats_and_mends_a_joint(after: ReadingFit, accepted: bool) -> None:
    """A likelihood ratio alone also favours the better of two wrong models."""
    assert ReadingTest(SIZE, 0.05).accepts(fit(0.0, 0.06, 0.4), after) is accepted


def test_a_reading_that_spares_the_bodies_needs_no_better_fit() -> None:
    """Bodies as in the file, not absurd ones, are evidence."""
    test, before = ReadingTest(SIZE, 0.05), fit(0.0, 0.03, 0.03, prior=40.0)
    assert test.accepts(before, fit(40.0, 0.03, 0.03, prior=1.0))
    assert not test.accepts(before, fit(40.0, 0.03, 0.03, prior=30.0))


def test_a_poor_fit_of_the_joints_concerned_is_no_mend() -> None:
    """A true reading is exact: it leaves what sound robots leave."""
    test = ReadingTest(SIZE, 0.05)
    assert test.is_mended(fit(0.0, 0.1, 0.5), (0,), (0, 1)) and not test.is_mended(fit(0.0, 0.1, 0.5), (1,), (0, 1))
    assert not test.is_good(fit(0.0, 0.1, 0.2), (0, 1), (0, 1))  # each joint counts, also the weak one


def test_only_noise_makes_the_finer_measure_hopeless() -> None:
    """Another reading explains what is correlated between samples, and none explains noise."""
    fine = ReadingTest(SIZE, 0.005, is_fine=True)
    poor = fit(0.0, 0.01, 0.04)
    assert is_hopeless(fine, poor, poor.power) and not is_hopeless(fine, poor, 0.1 * poor.power)
    assert is_hopeless(fine, fit(0.0, 0.01, 0.2), np.zeros(2))  # the coarser measure has judged such a joint
    assert not is_hopeless(ReadingTest(SIZE, 0.05), poor, poor.power)


def test_a_factor_far_from_one_is_known_to_be_wrong_without_its_size() -> None:
    """A tenth with a standard error of 30 % lies 7.6 of them from 1; a factor of 1.5 with 31 % may be 1."""
    assert is_factor_known(0.1, 0.301) and is_factor_known(-300.0, 0.6) and is_factor_known(1.5, 0.05)
    assert not is_factor_known(1.5, 0.31) and not is_factor_known(0.1, 0.5)


def test_both_halves_of_a_log_agree_on_a_true_reading() -> None:
    """Columns are named once for a whole log; a half without evidence is no objection."""
    assert is_preferred_in_each_half([40.0, 60.0]) and is_preferred_in_each_half([-0.5, 60.0])
    assert not is_preferred_in_each_half([-20.0, 160.0])


def test_a_direction_of_gravity_makes_no_joint_worse() -> None:
    """A spring at a wrist resembles another gravity there, and the other joint, which carries weight, contradicts it."""
    test, before, counts = ReadingTest(SIZE, 0.05), fit(0.0, 0.06, 0.4), np.array([200.0, 200.0])
    assert is_preferred_at_each_joint(test, before, fit(100.0, 0.06, 0.1), counts)
    assert not is_preferred_at_each_joint(test, before, fit(100.0, 0.062, 0.1), counts)
    assert is_preferred_at_each_joint(test, fit(0.0, 0.01, 0.4), fit(100.0, 0.03, 0.1), counts)  # below the model error


def test_a_recorded_velocity_vetoes_another_clock_and_confirms_it() -> None:
    """Velocities that agree with dq/dt exclude a clock at half speed; at twice dq/dt they demand it."""
    known = np.array([1.004, np.nan])
    assert permits_speed_scale(known, np.ones(2)) and not permits_speed_scale(known, np.full(2, 2.0))
    assert permits_speed_scale(2 * known, np.full(2, 2.0)) and not permits_speed_scale(2 * known, np.ones(2))


def test_limits_veto_forces_far_beyond_them() -> None:
    """Forces within their limits as logged do not become ten times the limit; without limits all is open."""
    assert not permits_size(np.array([80.0]), np.array([1000.0]), np.array([100.0]))
    assert permits_size(np.array([80.0]), np.array([1000.0]), np.array([np.inf]))
    assert permits_size(np.array([800.0]), np.array([1000.0]), np.array([100.0]))  # limits in another unit


def test_a_half_balanced_joint_does_not_lack_gravity() -> None:
    """A spring leaves a share of gravity; a controller's model leaves next to nothing."""
    assert is_part_missing(0.01, is_single=True) and not is_part_missing(0.1, is_single=True)
    assert is_part_missing(0.1, is_single=False) and not is_part_missing(0.5, is_single=False)


def test_a_mean_of_zero_is_evidence_only_where_the_model_has_one() -> None:
    """An offset would have to cancel gravity's mean by chance; a symmetric motion has no mean anyway."""
    nats = compute_zero_mean_nats(np.zeros(2), np.array([6.0, 0.1]), SIZE)
    assert nats[0] > 15 and nats[1] == 0
    assert compute_zero_mean_nats(np.array([3.0, 0.0]), np.array([6.0, 0.0]), SIZE)[0] < 1


def test_forces_that_the_bodies_explain_better_do_not_lack_them():
    """Residuals of 3 and 0.4 % are both below the model error; the reading that leaves 3 % is refused although it is likelier."""
    size = np.array([100.0])
    test = ReadingTest(size, 0.05)
    full = ReadingFit(10.0, 10.0, (0.004 * size) ** 2, 0.0, np.zeros((1, 1)))
    bare = ReadingFit(40.0, 40.0, (0.03 * size) ** 2, 0.0, np.zeros((1, 1)))
    assert not test.accepts_lack(full, bare)
    assert test.accepts_lack(ReadingFit(10.0, 10.0, (0.03 * size) ** 2, 0.0, np.zeros((1, 1))), bare)


def test_a_gain_alone_is_no_preference() -> None:
    """Error levels of 3 and 2.5 % over a thousand numbers differ by 180 nats, as two wrong models do."""
    assert not is_preferred(1000 * np.log(3 / 2.5), (2.5 / 3) ** 2)
    assert is_preferred(1000 * np.log(3 / 0.2), (0.2 / 3) ** 2) and not is_preferred(
        5 * np.log(3 / 0.2), (0.2 / 3) ** 2
    )


def test_the_good_share_belongs_to_the_data() -> None:
    """What is a good fit of forces, 10 % of their size, is a poor one of poses."""
    after = fit(0.0, 0.1, 0.1)
    assert ReadingTest(SIZE, 0.05).is_good(after, (0, 1), (0, 1))
    assert not ReadingTest(SIZE, 0.05, max_good_share=0.05).is_good(after, (0, 1), (0, 1))


def test_readings_within_five_nats_are_told_together() -> None:
    """A likelihood ratio of 150 is the border."""
    assert list_aliases([100.0, 94.0, 104.0, 99.5]) == [2, 0, 3]


def test_a_search_meets_the_simple_readings_first_and_ends_with_a_good_one() -> None:
    """Only "bc" is good: the beam of two holds "b", although "a" is likelier."""
    worth = {"a": 5.0, "b": 4.0, "c": 1.0, "bc": 9.0}

    def grow(last):
        grown = {"".join(sorted(base + letter)) for base in last for letter in "abc" if letter not in base}
        return sorted(grown, key=lambda r: -worth.get(r, 0.0))

    met = search_readings("", grow, 3, 2, lambda best: best == "bc")
    assert met[:3] == ["a", "b", "c"] and met[3] == "bc" and max(map(len, met)) == 2
    assert max(map(len, search_readings("", grow, 1, 2))) == 1
    assert "bc" not in search_readings("", grow, 2, 1)
