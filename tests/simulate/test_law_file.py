"""Controller files: the EMPS law, numbers a joint, and every fault in one sentence."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code

from tau_dyn.exceptions import InputError
from tau_dyn.simulate import CascadeLaw, read_law_file

EMPS = Path(__file__).parents[2] / "identification" / "controllers" / "emps.yaml"
GAINS = "position_gain: 40\nvelocity_gain: 4000\n"


@pytest.fixture
def read(gantry, tmp_path):
    """Return a function that reads YAML text as a controller file for the gantry."""

    def of(text: str) -> CascadeLaw:
        (tmp_path / "law.yaml").write_text(text)
        return read_law_file(tmp_path / "law.yaml", gantry.robot)

    return of


def test_emps_file_is_the_published_law(block):
    """The file and `CascadeLaw.emps` cannot drift apart."""
    found, published = read_law_file(EMPS, block.robot), CascadeLaw.emps()
    for key in ("position_gain", "velocity_gain", "integral_rate", "speed_feedforward", "force_per_unit", "limit"):
        assert_array_equal(getattr(found, key), getattr(published, key))


def test_numbers_may_be_one_a_list_or_a_mapping(read):
    """A list follows the order of the joints; a mapping does not care about order."""
    law = read(
        "position_gain: 40\nvelocity_gain: [1, 2, 3]\nintegral_rate: {cart3: 9, cart1: 7, cart2: 8}\nlimit: .inf\n"
    )
    assert_allclose(law.position_gain, 40.0)
    assert_allclose(law.velocity_gain, [1, 2, 3])
    assert_allclose(law.integral_rate, [7, 8, 9])
    assert np.all(np.isinf(law.limit))


def test_limit_defaults_to_the_drives_effort(read, gantry):
    """In the drive's own unit: 2000 N at 50 N/V are 40 V."""
    law = read(GAINS + "force_per_unit: 50\nlimit: null\n")
    assert_allclose(law.limit * law.force_per_unit, gantry.robot.effort_limit)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is a mapping with position_gain"),
        ("[1, 2]", "is a mapping with position_gain"),
        ("position_gain: 40", "'velocity_gain' is missing"),
        (GAINS + "gain: 3", "no controller entry named 'gain'; there are position_gain"),
        (GAINS + "1: 3", "no controller entry named '1'"),
        (GAINS + "limit: [1, 2]", "limit has 2 number(s) for 3 joint(s)"),
        (GAINS + "limit: {cart1: 3, cart2: 3}", "limit has no number for joint cart3"),
        (GAINS + "limit: {cart9: 3}", "no actuated joint named 'cart9'"),
        (GAINS + "limit: 0", "limit must be a number above zero, not 0"),
        (GAINS + "integral_rate: -1", "must be a finite number zero or more, not -1"),
        (GAINS + "force_per_unit: 0", "must be a finite number above zero"),
        (GAINS + "force_per_unit: .inf", "must be a finite number above zero"),
        (GAINS + "integral_rate: .nan", "must be a finite number"),
        (GAINS + "integral_rate: yes", "not True"),
        (GAINS + "integral_rate: 1e5", "YAML reads a number such as 1.0e+5"),
        (GAINS + "integral_rate: [[1], 2, 3]", "not [1]"),
        (GAINS + f"integral_rate: {'9' * 400}", "must be a finite number zero or more, not inf"),
        (GAINS + f"integral_rate: {'x' * 400}", "..."),
        ("position_gain: !!python/object:os.system 1", "not valid YAML"),
        ("position_gain: [", "not valid YAML"),
        ("position_gain: 1.0\nposition_gain: 2.0", "position_gain stands twice"),
    ],
)
def test_each_fault_is_one_short_sentence(read, text, words):
    """Named with the file, on one line."""
    with pytest.raises(InputError, match="law.yaml") as fault:
        read(text)
    message = str(fault.value)
    assert words in message and "\n" not in message and len(message) < 500


def test_missing_file_is_said(gantry, tmp_path):
    """No traceback for a wrong path."""
    with raises_code("file_not_found"):
        read_law_file(tmp_path / "none.yaml", gantry.robot)
