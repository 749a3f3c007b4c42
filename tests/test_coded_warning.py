"""Warnings keep their codes wherever they travel."""

import pickle

from tau_dyn.coded_warning import CodedWarning, format_warnings


def test_codes_stand_parallel_to_the_sentences():
    """A program reads the code, a person the sentence; what is said twice stands once."""
    lost = CodedWarning("lost_samples", "9 samples are missing")
    assert format_warnings([lost, "something else", lost]) == {
        "warnings": ["9 samples are missing", "something else"],
        "warning_codes": ["lost_samples", "note"],
    }


def test_a_code_survives_another_process():
    """A worker's warning comes back with its code."""
    assert pickle.loads(pickle.dumps(CodedWarning("held_channel", "q_a is held"))).code == "held_channel"
