"""A robot file in mm, or with inertias in kg mm^2, is read as it is written, with a warning that names the unit."""

from __future__ import annotations

import re

import pytest

from tau_dyn.robot import load_robot_from_urdf


def _units(urdf: str) -> list[str]:
    return [w for w in load_robot_from_urdf(urdf, "arm").warnings if "mm" in w]


@pytest.fixture
def arm(write) -> str:
    """Return an arm in SI units."""
    return write.two_link()


def test_an_arm_in_si_units_gets_no_warning(arm):
    """Metres and kg m^2 of a usual arm are plausible."""
    assert _units(arm) == []


def test_lengths_in_mm_are_named(arm):
    """No robot has neighbouring joints 100 m apart."""
    text = re.sub(r'xyz="([^"]+)"', lambda m: f'xyz="{" ".join(str(1000 * float(x)) for x in m[1].split())}"', arm)
    assert any("are lengths in mm" in w for w in _units(text))


def test_inertias_in_kg_mm2_are_named_for_each_heavy_body(arm):
    """A body of some kg whose radius of gyration is a hundred metres is thinner than air; a dummy link's is ignored."""
    text = re.sub(r'(i[xyz][xyz])="([^"]+)"', lambda m: f'{m[1]}="{1e6 * float(m[2])}"', arm)
    assert [w.split("'")[1] for w in _units(text)] == ["shoulder", "elbow"]
    assert all("kg mm^2" in w for w in _units(text))
