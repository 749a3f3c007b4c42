"""A robot file in mm, or with inertias in kg mm^2, is read as it is written, with a warning that names the unit."""

from __future__ import annotations

import re

import pytest

from tau_dyn.robot import load_robot_from_urdf


def _list(urdf: str) -> list[str]:
    return list(load_robot_from_urdf(urdf, "arm").warnings)


def _units(urdf: str) -> list[str]:
    return [w for w in _list(urdf) if "mm" in w]


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


def test_limits_in_degrees_are_named(arm):
    """A joint of an arm turns less than four times; a slide of 30 m and a joint without limits are no such joint."""
    wide = re.sub(r'lower="[^"]*" upper="[^"]*"', 'lower="-170" upper="170"', arm)
    assert wide != arm and any("shoulder, elbow reach -170 to 170 rad; are they in degrees" in w for w in _list(wide))
    assert not any("degrees" in w for w in _list(wide.replace("revolute", "prismatic")))
    assert not any("degrees" in w for w in _list(wide.replace("revolute", "continuous")))
