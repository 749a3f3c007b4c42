"""The tool channel: displacements hidden in tool positions of an L1, by code that knows nothing of the effects' own."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from raising import raises_code

from tau_dyn.diagnose import diagnose
from tau_dyn.diagnose.pipeline import diagnose_tool
from tau_dyn.diagnose.preparation import choose_diagnosis_preparation
from tau_dyn.diagnose.tool_channel import build_tool_channel, build_tool_segment
from tau_dyn.effects import EFFECTS
from tau_dyn.evidence.candidate_scan import compute_explained
from tau_dyn.evidence.channel import ColumnCache
from tau_dyn.evidence.detection_limits import compute_alias_periods
from tau_dyn.evidence.null_model import NullModel, fit_noise_models
from tau_dyn.log import Log
from tau_dyn.mechanism import GantryTauMechanism
from tau_dyn.model import Model
from tau_dyn.robot import load_robot

NOISE = 4e-5  # [m] of the tool's measurement, each axis
PERIOD = 0.0209  # [m] of a pinion's tooth

robot = load_robot("gantry_tau")
model = Model.of(robot)
mechanism = GantryTauMechanism(robot)


def tool_at(q: np.ndarray, u: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the tool (N, 3) with carts displaced by `u` (N, 3, 3), by Newton on the three spheres."""
    carts = mechanism.origin + q[:, :, None] * mechanism.direction + u
    tool = mechanism.tool_position(q)
    for _ in range(5):
        D = tool[:, None] - carts
        tool = tool - np.linalg.solve(D, 0.5 * (np.sum(D**2, axis=2) - mechanism.length**2)[:, :, None])[:, :, 0]
    return tool


def recorded(
    t: np.ndarray, encoder: np.ndarray, tool: np.ndarray, rng: np.random.Generator, noise: float = NOISE
) -> Log:
    """Return a log with a noisy tool."""
    tool = tool + noise * rng.standard_normal(tool.shape)
    columns = dict(zip(("x_tool", "y_tool", "z_tool"), tool.T, strict=True))
    return Log(t, {f"q_{j}": encoder[:, k] for k, j in enumerate(robot.actuated)} | columns, name="measured")


def poses(rng: np.random.Generator, n: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Return uneven times and random cart positions of poses held still."""
    return np.cumsum(rng.uniform(2, 6, n)), robot.home + rng.uniform(-0.25, 0.25, (n, 3))


def moving(rng: np.random.Generator, duration: float = 40.0, rate: float = 200.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a clock and smooth cart motion."""
    t = np.arange(0, duration, 1 / rate)
    q = np.tile(robot.home, (len(t), 1))
    for f in (0.11, 0.23, 0.37, 0.5):
        phase = 2 * np.pi * (f * t[:, None] * (1, 1.03, 1.06) + rng.uniform(0, 1, 3))
        q += rng.uniform(0.03, 0.08, 3) * np.sin(phase)
    return t, q


def shifted_by_load(q: np.ndarray) -> np.ndarray:
    """Return the tool (N, 3) with cart 2 shifted across its guideway by up to 100 um more in one place than in another."""
    rest = np.zeros_like(q)
    side = mechanism.guide_force(q, rest, rest)
    u = np.zeros_like(side)
    u[:, 1] = side[:, 1] * 1e-4 / np.ptp(np.linalg.norm(side[:, 1], axis=1))
    return tool_at(q, u)


def play(x: np.ndarray, width: float) -> np.ndarray:
    """Return encoder minus load (N,) of a gap that the encoder has to cross, followed from sample to sample."""
    out = np.zeros_like(x)
    for k in range(1, len(x)):
        out[k] = np.clip(out[k - 1] + x[k] - x[k - 1], -width / 2, width / 2)
    return out


def cyclic(x: np.ndarray) -> np.ndarray:
    """Return an error (N,) of 20 um with a second harmonic."""
    return 2e-5 * np.sin(2 * np.pi * x / PERIOD + 0.4) + 3e-6 * np.sin(4 * np.pi * x / PERIOD)


def line(steps: np.ndarray) -> np.ndarray:
    """Return all carts moving alike along the guideways and back, again and again (N, 3)."""
    way = np.concatenate([steps, steps[::-1]] * 10)
    return robot.home + way[:, None]


def test_clean_poses_stay_clean(rng) -> None:
    """A turned and shifted measuring frame and zeros of the encoders are refitted, and nothing is named."""
    t, q = poses(rng)
    c, s = np.cos(0.3), np.sin(0.3)
    turned = tool_at(q + [1e-3, -2e-3, 5e-4]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [1, 2, 3]
    found = diagnose_tool(model, [recorded(t, q, turned, rng)])
    assert found.verdict == "nothing_found" and found.exit_status == 0
    assert_allclose(found.baseline.rms, NOISE, rtol=0.2)
    assert found.channel == "tool" and found.outputs == ("x_tool", "y_tool", "z_tool")
    assert not found.extended_model.effects


def test_carts_shifted_by_their_load_are_found_in_poses(rng) -> None:
    """100 um over the workspace behind 40 um of noise: guideway compliance of cart 2, of the size hidden."""
    t, q = poses(rng, 400)
    rest = np.zeros_like(q)
    size = np.linalg.norm(mechanism.guide_force(q, rest, rest)[:, 1], axis=1)
    found = diagnose_tool(model, [recorded(t, q, shifted_by_load(q), rng)])
    first = found.findings[0]
    assert found.verdict == "named" and first.cause == "guideway_compliance" and first.joints == ("cart2",)
    value = next(iter(first.parameters))
    assert value.value == pytest.approx(1e-4 / np.ptp(size), abs=4 * (value.stderr or 0))
    assert first.status == "confirmed" and first.gain is not None and first.gain.reduction_percent > 0
    assert "guideway_compliance" in {e.name for e in found.extended_model.effects}
    assert len({limit.cause for limit in found.limits}) == len(found.limits)


def test_backlash_is_found_while_moving(rng) -> None:
    """A play of 40 um in cart 2, the encoder reading on: backlash (or its double) within four standard errors."""
    t, q = moving(rng)
    load = q.copy()
    load[:, 1] -= play(q[:, 1], 4e-5)
    found = diagnose_tool(model, [recorded(t, q + 3e-6 * rng.standard_normal(q.shape), tool_at(load), rng)])
    first = found.findings[0]
    assert found.verdict == "named" and first.joints[0] == "cart2"
    assert "backlash" in (first.cause, *first.indistinguishable_from)
    value = next(iter(first.parameters))
    width = value.value * (1 if first.cause == "backlash" else 2)
    assert width == pytest.approx(4e-5, rel=0.2)
    assert np.all(found.extended.rms <= found.baseline.rms * 1.05)


def test_a_cyclic_error_is_found_while_moving(rng) -> None:
    """20 um every 20.9 mm behind 40 um of noise: transmission error with its period."""
    t, q = moving(rng)
    load = q.copy()
    load[:, 2] -= cyclic(q[:, 2])
    found = diagnose_tool(model, [recorded(t, q + 3e-6 * rng.standard_normal(q.shape), tool_at(load), rng)])
    first = found.findings[0]
    assert found.verdict == "named"
    assert (first.cause, first.joints[0]) == ("transmission_error", "cart3")
    assert first.effects[0].settings["period"] == pytest.approx(PERIOD, rel=0.02)
    sine, cosine = list(first.parameters)[:2]
    assert np.hypot(sine.value, cosine.value) == pytest.approx(2e-5, rel=0.2)


def test_a_cyclic_error_at_places_too_far_apart_has_no_known_period(rng) -> None:
    """Every 50 mm along the guideways, as thesis 4.2 suspects: cannot tell, and the finer spacing that would."""
    q = line(np.arange(-0.6, 0.65, 0.05))
    load = q.copy()
    load[:, 2] -= cyclic(q[:, 2])
    log = recorded(4.0 * np.arange(len(q)), q, tool_at(load), rng, 3e-5)
    found = diagnose_tool(model, [log])
    assert found.verdict == "cannot_tell" and found.exit_status == 3
    assert found.findings[0].cause == "transmission_error" and found.findings[0].status == "suspected"
    assert "steps of" in found.experiment and "uneven" in found.experiment and "50 mm" in found.sentence
    assert not found.extended_model.effects
    channel = build_tool_channel(model, [log])
    null_model = NullModel.of(ColumnCache(channel), (0,), fit_noise_models(channel, (0,)))
    periods = np.array(compute_alias_periods(null_model, found.findings[0].effects[0]))
    assert len(periods) > 10
    assert np.abs(periods / PERIOD - 1).min() < 0.01  # the truth is among them
    folded = np.mod(1 / periods * 0.05 + 0.5, 1) - 0.5  # periods a step, without whole ones
    assert_allclose(np.abs(folded), abs(np.mod(0.05 / PERIOD + 0.5, 1) - 0.5), atol=0.02)


def test_uneven_steps_give_the_period_away(rng) -> None:
    """As many places, not 50 mm apart but at random: the period is known."""
    q = line(np.sort(rng.uniform(-0.6, 0.6, 26)))
    load = q.copy()
    load[:, 2] -= cyclic(q[:, 2])
    found = diagnose_tool(model, [recorded(4.0 * np.arange(len(q)), q, tool_at(load), rng, 3e-5)])
    assert found.verdict == "named"
    assert found.findings[0].effects[0].settings["period"] == pytest.approx(PERIOD, rel=0.01)


def test_only_what_can_be_told_apart_is_refitted(rng) -> None:
    """On parallel guideways three equal zeros are a shift of the frame; on one line its turn about the line is unknown."""
    t, q = poses(rng)
    frame = ("frame.x", "frame.y", "frame.z", "frame.rx", "frame.ry", "frame.rz")
    assert build_tool_channel(model, [recorded(t, q, tool_at(q), rng)]).parameters.names == (
        *frame,
        "cart1.zero",
        "cart2.zero",
    )
    q = line(np.linspace(-0.5, 0.5, 20))
    channel = build_tool_channel(model, [recorded(np.arange(400.0), q, tool_at(q), rng)])
    assert "frame.rx" not in channel.parameters.names


def test_poses_remember_the_side_they_were_approached_from(rng) -> None:
    """A joint that stands keeps its side and its way; one that turns back starts its way anew; the first pose is unknown."""
    q = np.repeat(robot.home[None], 150, axis=0) + 0.001 * rng.uniform(-1, 1, (150, 3))
    q[:6, 0] = robot.home[0] + np.array([0.0, 0.1, 0.15, 0.15, 0.05, 0.02])
    (piece,) = build_tool_channel(model, [recorded(np.arange(150.0), q, tool_at(q), rng)]).pieces
    assert_allclose(piece.motion.sign[:6, 0], [0, 1, 1, 1, -1, -1])
    assert_allclose(piece.motion.signals["reversal"][:6, 0], [0, 0.1, 0.15, 0.15, 0.1, 0.13], atol=1e-12)
    assert not piece.usable[0] and piece.usable[1:].all()


def test_quick_columns_are_the_exact_ones_through_the_filter(rng) -> None:
    """Periods are scanned on decimated motion with the low-pass's gain: nearly what the exact columns explain."""
    t, q = moving(rng)
    load = q.copy()
    load[:, 2] -= cyclic(q[:, 2])
    channel = build_tool_channel(model, [recorded(t, q, tool_at(load), rng)])
    null_model = NullModel.of(ColumnCache(channel), (0,), fit_noise_models(channel, (0,)))
    effect = EFFECTS["transmission_error"](["cart3"], ["N"], period=PERIOD)
    quick = compute_explained([effect], null_model, null_model.e[:, None])
    C = null_model.whiten_columns(channel.columns(effect))
    s = C.T @ null_model.e
    assert channel.quick_columns(effect) is not None
    assert quick[0, 0] == pytest.approx(s @ np.linalg.solve(null_model.gram(C), s), rel=0.1)


def test_what_is_missing_is_said(rng) -> None:
    """No tool columns, too few poses, a tool that was lost on the way; lost poses are left out."""
    t, q = poses(rng, 30)
    log = recorded(t, q, tool_at(q), rng)
    with raises_code("missing_column", "x_tool"):
        build_tool_channel(model, [Log(t, {k: x for k, x in log.channels.items() if "tool" not in k})])
    with raises_code("too_little_data"):
        build_tool_channel(model, [log])
    t, q = moving(rng, 10.0)
    log = recorded(t, q, tool_at(q), rng)
    with raises_code("bad_sample", "3"):
        build_tool_channel(
            model, [log.with_channels(y_tool=np.where(np.arange(len(t)) < 3, np.nan, log.channels["y_tool"]))]
        )
    t, q = poses(rng)
    log = recorded(t, q, tool_at(q), rng)
    lost = log.with_channels(z_tool=np.where(np.arange(len(t)) % 50 == 7, np.nan, log.channels["z_tool"]))
    assert len(build_tool_channel(model, [lost]).pieces[0].measured) == len(t) - 6


def test_logs_in_different_frames_are_refused(rng) -> None:
    """A tracker set up anew between two logs leaves metres that no cause explains: said so, not diagnosed."""
    t, q = poses(rng, 100)
    one, other = recorded(t, q, tool_at(q), rng), recorded(t, q, tool_at(q)[:, [1, 2, 0]], rng)
    with raises_code("wrong_unit"):
        build_tool_channel(model, [one, other])


def test_forces_that_are_not_there_are_missed(rng):
    """Whoever forgot a force column is told that only positions were looked at, and which column would change that."""
    t, q = poses(rng, 60)
    found = diagnose(robot, [recorded(t, q, tool_at(q), rng)])
    assert (
        found.warnings[0]
        == "forces were not looked at, only positions: the logs have no tau_cart1, tau_cart2, tau_cart3"
    )


def test_a_cart_that_stands_exactly_still_spoils_no_sample(rng):
    """Rounding turns the sign of a velocity that is zero; that is no reversal, and the tool is looked at all the same."""
    t, q = moving(rng, 8.0)
    q[:, 2] = robot.home[2]
    log = recorded(t, q, tool_at(q), rng)
    piece = build_tool_segment(model, log, choose_diagnosis_preparation(robot, [log], ()))
    assert piece.usable.mean() > 0.5


@pytest.mark.parametrize("still", [True, False])
def test_a_guideway_off_by_a_milliradian_has_its_name(rng, still) -> None:
    """Cart 1's guideway points 1 mrad upwards and 0.5 aside, in poses and in motion: both angles, and no wave of an encoder."""
    t, q = poses(rng) if still else moving(rng)
    u = np.zeros((len(q), 3, 3))
    u[:, 0] = q[:, 0, None] * np.array([0.0, 5e-4, 1e-3])
    found = diagnose_tool(model, [recorded(t, q, tool_at(q, u), rng)])
    first = found.findings[0]
    assert first.cause == "guideway_nonparallel" and first.joints == ("cart1",) and first.status == "confirmed"
    values = {p.name: p for p in first.parameters}
    for name, truth in (("cart1.direction_y", 5e-4), ("cart1.direction_z", 1e-3)):
        assert abs(values[name].value - truth) < 4 * (values[name].stderr or 0) + 2e-5
    assert "transmission_error" not in {f.cause for f in found.findings if f.status == "confirmed"}
