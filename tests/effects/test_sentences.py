"""What a person reads of every effect: the whole sentence, with its numbers put in by hand, for one joint and for two."""

from __future__ import annotations

from typing import Any, cast

import pytest

from tau_dyn.effects import EFFECTS, Effect, format_quantity, spell_unit


def said(name: str, values: dict[str, float], joints: str = "x", stderr: float | None = None, **settings: float) -> str:
    """Return an effect's sentence on slides x and y and a hinge w; values by quantity, errors as a share of them."""
    units = [{"x": "N", "y": "N", "w": "N m"}[joint] for joint in joints]
    effect: Effect = EFFECTS[name](list(joints), units, **cast("Any", settings))
    found = {p.name: p.name.split(".", 1)[1] for p in effect.parameters}
    known = {n: values[n] if n in values else values.get(key, 0.0) for n, key in found.items()}
    errors = {} if stderr is None else {n: {"stderr": stderr * abs(x)} for n, x in known.items()}
    return effect.describe(effect.parameters.with_values(known).update(errors))


ONE_SLIDE = [
    ("symmetric_friction", {"coulomb": 80.0, "viscous": 120.0}, {}, "coulomb of 80 N and viscous of 120 N/(m/s)"),
    ("coulomb_asymmetry", {"coulomb_asymmetry": 6.0}, {},
     "Coulomb friction 12 N higher when moving forward than the other way"),
    ("coulomb_asymmetry", {"coulomb_asymmetry": -6.0}, {},
     "Coulomb friction 12 N higher when moving backward than the other way"),
    ("viscous_asymmetry", {"viscous_asymmetry": -5.0}, {},
     "viscous friction 10 N/(m/s) higher when moving backward than the other way"),
    ("stribeck", {"stribeck": 12.0}, {"speed": 0.02},
     "a Stribeck peak of 12 N, of which 5 % are left at 60 mm/s"),
    ("stribeck", {"stribeck": 12.0}, {"speed": 0.02, "power": 2},
     "a Stribeck peak of 12 N, of which 5 % are left at 34.6 mm/s"),
    ("load_friction", {"load_friction": 0.05}, {}, "friction of 5 % of the load that its guide or reducer carries"),
    ("thermal_drift", {"thermal_coulomb": -2.0, "thermal_viscous": -3.0}, {},
     "friction that changes with temperature by -2 N/K and -3 N/(m/s K)"),
    ("thermal_drift", {"thermal_coulomb": -2.0, "thermal_viscous": -3.0}, {"lag": 90.0},
     "friction that changes with temperature by -2 N/K and -3 N/(m/s K), 90 s behind the sensor"),
    ("passive_joint_friction", {"viscous": 0.2, "coulomb": 0.7}, {},
     "friction of 0.7 N m and 0.2 N m/(rad/s) in every joint without a motor"),
    ("quadratic_drag", {"quadratic_drag": 8.0}, {}, "a drag of 8 N/(m/s)^2 times the speed squared"),
    ("torque_offset", {"offset": -2.5}, {}, "a constant force of -2.5 N"),
    ("drive_gain", {"gain_error": 0.03}, {}, "a drive whose reported force is off by 3 %"),
    ("cyclic_ripple", {"ripple_sin": 3.0, "ripple_cos": -4.0}, {"period": 0.0209},
     "a force of 5 N that repeats every 20.9 mm"),
    ("delay", {"delay": 2e-3}, {}, "forces logged 2 ms after the positions"),
    ("delay", {"delay": -2e-3}, {}, "forces logged -2 ms after the positions (negative: before them)"),
    ("backlash", {"backlash": 4e-5}, {}, "a play of 40 µm between encoder and load"),
    ("hysteresis", {"hysteresis": 6.0}, {"distance": 2e-3},
     "6 N of the friction that builds up over 2 mm after a reversal"),
    ("hysteresis", {"lost_motion": 3e-5}, {"distance": 2e-3, "displaced": 1},
     "a loop of 30 µm to either side between encoder and load, entered over 2 mm"),
    ("transmission_error", {"error_sin": 3e-5, "error_cos": 4e-5}, {"period": 0.04},
     "an error of 50 µm between encoder and load that repeats every 40 mm"),
    ("pinion_scale", {"pinion_scale": 1e-3}, {}, "positions read too long by 0.1 %"),
    ("structural_compliance", {"structural_compliance": 2e-7, "structural_compliance_2": 5e-8},
     {"frequency": 7.4, "damping": 0.01, "modes": 2, "frequency_2": 11.5, "damping_2": 0.025},
     "a resonance at 7.4 Hz, damping 1 %, of a part that yields by 200 nm/N and a resonance at 11.5 Hz, damping 2.5 %, of a "
     "part that yields by 50 nm/N"),
    ("joint_compliance", {"compliance": 2e-8}, {}, "a drive that yields by 20 nm/N, a stiffness of 50 MN/m"),
    ("joint_compliance", {"compliance": 0.0}, {}, "a drive that yields by 0 m/N"),
    ("guideway_compliance", {"guideway_compliance": 2e-7}, {}, "the cart yields across its guideway by 200 nm/N"),
    ("friction_change", {"coulomb_change": 15.0, "viscous_change": -4.0}, {"number": 1},
     "friction in log 2 that differs from the others' by 15 N and -4 N/(m/s)"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "values", "settings", "sentence"), ONE_SLIDE)
def test_a_slides_sentence(name: str, values: dict[str, float], settings: dict[str, float], sentence: str) -> None:
    """Amounts in handy units; what is not there, such as a lag of nothing, is not spoken of."""
    assert said(name, values, **settings) == sentence


HINGE_TOO = [
    ("symmetric_friction", {"coulomb": 80.0, "viscous": 120.0},
     "coulomb of 80 N and viscous of 120 N/(m/s) at x; coulomb of 80 N m and viscous of 120 N m/(rad/s) at w"),
    ("stribeck", {"stribeck": 12.0}, "a Stribeck peak of 12 N, of which 5 % are left at 60 mm/s at x; "
                                     "a Stribeck peak of 12 N m, of which 5 % are left at 60 mrad/s at w"),
    ("backlash", {"backlash": 4e-5}, "a play of 40 µm between encoder and load at x; "
                                     "a play of 40 µrad between encoder and load at w"),
    ("joint_compliance", {"compliance": 2e-5}, "a drive that yields by 20 µm/N, a stiffness of 50 kN/m at x; "
                                               "a drive that yields by 20 µrad/(N m), a stiffness of 50 kN m/rad at w"),
    ("delay", {"delay": 2e-3}, "forces of x, w logged 2 ms after the positions"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "values", "sentence"), HINGE_TOO)
def test_several_joints_are_told_apart_in_their_own_units(name: str, values: dict[str, float], sentence: str) -> None:
    """A slide's lengths and forces, a hinge's angles and torques, each with its joint."""
    assert said(name, values, "xw") == sentence


def test_carts_are_told_apart() -> None:
    """Two guideways that yield by different amounts; two rod ends that are carried off theirs."""
    soft = {"x.guideway_compliance": 2e-7, "y.guideway_compliance": 3e-7}
    sentence = "the cart yields across its guideway by 200 nm/N at x and 300 nm/N at y"
    assert said("guideway_compliance", soft, "xy") == sentence
    wave = "the rod's end is carried off its line by {} at {}, in a wave of 500 mm along the guideway"
    tilts = {"x.tilt_sin_y": 3e-5, "x.tilt_cos_z": 4e-5, "y.tilt_cos_x": 2e-5}
    sentence = "; ".join((wave.format("50 µm", "x"), wave.format("20 µm", "y")))
    assert said("cart_tilt", tilts, "xy", period=0.5) == sentence


def test_a_shared_motor_names_both_joints() -> None:
    """Inertia, viscous and Coulomb friction, in this order."""
    sentence = "a motor shared by x and y, with inertia 3 N s^2/m, viscous friction 4 N/(m/s) and Coulomb friction 5 N"
    assert said("reducer_coupling", {"inertia": 3.0, "viscous": 4.0, "coulomb": 5.0}, "xy") == sentence


def test_friction_along_the_way_names_its_ends() -> None:
    """3 x over half a metre either side of 0.2 m: 6 N from end to end; the other way round where it falls."""
    settings = {"middle": 0.2, "half": 0.5, "degree": 1}
    assert (
        said("position_friction", {"position_friction_1": 3.0}, **settings)
        == "friction 6 N higher at 700 mm than at -300 mm"
    )
    assert (
        said("position_friction", {"position_friction_1": -3.0}, **settings)
        == "friction 6 N higher at -300 mm than at 700 mm"
    )


@pytest.mark.parametrize(
    ("name", "values", "sentence"),
    [
        ("coulomb_asymmetry", {"coulomb_asymmetry": 6.0},
         "Coulomb friction 12.0 ± 1.2 N higher when moving forward than the other way"),
        ("load_friction", {"load_friction": 0.05},
         "friction of 5.00 ± 0.50 % of the load that its guide or reducer carries"),
        ("cyclic_ripple", {"ripple_sin": 3.0, "ripple_cos": -4.0}, "a force of 5.00 ± 0.37 N that repeats every 20 mm"),
        ("joint_compliance", {"compliance": 2e-8}, "a drive that yields by 20.0 ± 2.0 nm/N, a stiffness of 50.0 ± 5.0 MN/m"),
    ],
)  # fmt: skip
def test_errors_follow_their_amounts(name: str, values: dict[str, float], sentence: str) -> None:
    """Ten per cent of each: twice half a difference, a hypotenuse by `hypot(s 0.3, c 0.4) / a`, a reciprocal at equal share."""
    assert said(name, values, stderr=0.1) == sentence


def test_an_amount_takes_the_prefix_that_fits_or_the_nearest() -> None:
    """Down to the smallest prefix there is, and below it still in that; a unit without prefixes keeps its own."""
    for value, text in ((2.0, "2 m"), (2e-3, "2 mm"), (2e-6, "2 µm"), (2e-9, "2 nm"), (2e-11, "0.02 nm")):
        assert format_quantity(value, "m") == text and format_quantity(-value, "m") == f"-{text}"
    for value, text in ((2e10, "20 GN/m"), (2e9, "2 GN/m"), (2e6, "2 MN/m"), (2e3, "2 kN/m"), (0.5, "0.5 N/m")):
        assert format_quantity(value, "N/m") == text
    assert format_quantity(2e-7, "rad/(N m)") == "200 nrad/(N m)" and format_quantity(3e5, "N m/rad") == "300 kN m/rad"
    assert (
        format_quantity(5e-4, "m/s") == "500 µm/s"
        and format_quantity(5e-5, "rad/s") == "0.05 mrad/s"
        and format_quantity(2e-8, "s") == "0.02 µs"
    )
    assert (
        format_quantity(1e-7, "N") == "1e-07 N"
        and format_quantity(0.02, "1") == "0.02"
        and format_quantity(0.0, "N") == "0 N"
    )


@pytest.mark.parametrize(
    ("stderr", "text"),
    [(0.2, "1.80 ± 0.20"), (0.0996, "1.80 ± 0.10"), (0.0994, "1.800 ± 0.099"), (9.96, "2 ± 10"), (123.0, "2 ± 123"),
     (2e-9, "1.8 ± 2e-09"), (0.0, "1.8"), (float("inf"), "1.8"), (float("nan"), "1.8")],
)  # fmt: skip
def test_an_error_has_two_digits_and_its_amount_ends_with_them(stderr: float, text: str) -> None:
    """0.0996 rounds up to 0.10; no error, or none that is a number, leaves three digits of the amount."""
    assert format_quantity(1.8, "N", stderr) == f"{text} N"


def test_units_are_spelled_for_a_slide_and_a_hinge() -> None:
    """F, V and Q are force, speed and place; a force of two words stands in brackets below a fraction's line."""
    assert [spell_unit("F/(V)", force) for force in ("N", "N m")] == ["N/(m/s)", "N m/(rad/s)"]
    assert [spell_unit("Q/F", force) for force in ("N", "N m")] == ["m/N", "rad/(N m)"]
    assert spell_unit("F s^2/Q", "N m") == "N m s^2/rad"
