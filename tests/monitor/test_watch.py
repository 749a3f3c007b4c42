"""A watch names what changed and since when, and stays silent where nothing has."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from tau_dyn.cli import main
from tau_dyn.effects import build_friction_model
from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.log import Log
from tau_dyn.message_codes import get_code
from tau_dyn.model import Model
from tau_dyn.monitor import BlockScore, ChangeDetector, GrowingFile, watch_logs
from tau_dyn.robot import load_robot
from tau_dyn.simulate import build_fourier_motion

ROBOT = load_robot("gantry_tau")
AT = 85.0  # [s] of the change


def build() -> Model:
    """Return the L1 with friction of 20 N and 40 N/(m/s)."""
    model = Model.of(ROBOT, build_friction_model("asymmetric", ROBOT.actuated, ROBOT.force_units))
    return model.with_values({p.name: 20.0 if "coulomb" in p.name else 40.0 for p in model.effect_parameters})


MODEL = build()
MOTION = build_fourier_motion(MODEL, 130.0, 7).every(8)
NORMAL = MODEL.torque(MOTION.q, MOTION.v, MOTION.a)
NOISE = np.random.default_rng(0).standard_normal(NORMAL.shape)


def record(changed: np.ndarray | None = None, name: str = "log.csv") -> Log:
    """Return 130 s of the normal robot, with other forces from 85 s on."""
    tau = NORMAL if changed is None else np.where((MOTION.t >= AT)[:, None], changed, NORMAL)
    tau = tau + 1.5 * NOISE
    columns = {f"q_{j}": MOTION.q[:, k] for k, j in enumerate(ROBOT.actuated)}
    return Log(MOTION.t, columns | {f"tau_{j}": tau[:, k] for k, j in enumerate(ROBOT.actuated)}, name)


def change(**values: float) -> np.ndarray:
    """Return the forces of the model at other values."""
    return MODEL.with_values({k.replace("__", "."): v for k, v in values.items()}).torque(MOTION.q, MOTION.v, MOTION.a)


def test_nothing_is_said_of_a_robot_that_stays_as_it_is() -> None:
    """The same robot for two minutes raises no alarm; a model that is off by 3 % of its friction is off from the start on."""
    off = MODEL.with_values({p.name: 1.03 * p.value for p in MODEL.effect_parameters})
    assert not watch_logs(MODEL, [record()]).changes
    assert not watch_logs(off, [record()]).changes


def test_a_reference_that_the_model_contradicts_is_doubted() -> None:
    """Forces of the wrong sign from the start on are no change, but no normal state either."""
    log = record()
    turned = log.with_channels(**{name: -x for name, x in log.channels.items() if name.startswith("tau")})
    assert "sign_reversed" in {get_code(w) for w in watch_logs(MODEL, [turned]).warnings}
    assert not watch_logs(MODEL, [log]).warnings


CASES = {
    "friction": (
        change(cart2__coulomb_pos=22.0, cart2__coulomb_neg=22.0, cart2__viscous_pos=44.0, cart2__viscous_neg=44.0), "cart2", 0.1,
    ),
    "payload": (change(plate_link__mass=9.63), None, 0.5),
    "delay": (
        np.column_stack([np.interp(MOTION.t - 0.003, MOTION.t, x) for x in NORMAL.T]), None, 0.003,
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", CASES)
def test_a_change_is_named_with_its_size_and_its_time(what) -> None:
    """10 % more friction, half a kilogram, and 3 ms of delay are told apart within seconds, and since when."""
    forces, joint, size = CASES[what]
    found = watch_logs(MODEL, [record(forces)])
    (row,), (finding,) = found.rows(), found.to_dict()["findings"]
    cause = {"friction": "friction_change"}.get(what, what)
    assert (finding["cause"], finding["joints"], finding["status"]) == (cause, [joint] if joint else [], "parameter")
    assert finding["parameters"][0]["value"] == row["size"] and finding["p_value"] < 1e-4
    assert (row["what"], row["joint"]) == (what, joint)
    assert abs(row["size"] - size) < 0.25 * size and row["ci95"][0] < row["size"] < row["ci95"][1]
    assert row["since_ci95"][0] <= AT <= row["since_ci95"][1] < AT + 8
    assert AT < row["detected_t"] < AT + 30 and row["false_alarm_rate"] < 1e-4


def test_an_offset_of_an_encoder_has_the_sign_of_joint_zero() -> None:
    """A cart that is 20 mm short of its logged position has a `joint_zero` of +20 mm, within a tenth."""
    offset = np.outer(np.where(MOTION.t > AT, 0.02, 0.0), [name == "cart2" for name in ROBOT.actuated])
    forces = MODEL.torque(MOTION.q - offset, MOTION.v, MOTION.a)
    (finding,) = watch_logs(MODEL, [record(forces)]).findings
    assert finding.cause == "joint_zero" and finding.joints == ("cart2",)
    assert finding.parameters[0].name == "cart2.joint_zero"
    assert abs(finding.parameters[0].value - 0.02) < 0.002


def draw_block(rng: np.random.Generator, k: int, theta: np.ndarray) -> BlockScore:
    """Return one block of white rows in which directions have amplitudes (D,)."""
    X = rng.standard_normal((40, len(theta)))
    e = 3.0 * (X @ theta + rng.standard_normal(40))  # three times the noise that the scores are made for
    return BlockScore((2.0 * k, 2.0 * k + 2.0), "log", X.T @ e, X.T @ X, float(e @ e), len(e))


def test_alarms_come_as_seldom_as_stated_whatever_the_noise() -> None:
    """At one false alarm an hour, 9 h of equal blocks raise no more than that, though noise is three times as large."""
    rng, D = np.random.default_rng(1), 3
    raised = 0
    for _ in range(3):
        detector = ChangeDetector(np.full(D, 10.0), 30, 1.0)
        for k in range(5400):
            detector.add(draw_block(rng, k, np.zeros(D)))
        raised += len(detector.changes)
    assert raised <= stats.poisson.ppf(0.99, 9.0)  # 9 h at one an hour


def test_since_when_is_covered() -> None:
    """The true change lies within the interval of its time in nearly all of 40 cases, its size within that of its size."""
    rng, covered, sized = np.random.default_rng(2), 0, 0
    for _ in range(40):
        detector = ChangeDetector(np.full(3, 10.0), 30)
        for k in range(130):
            detector.add(draw_block(rng, k, np.array([0.0, 0.8 * (k >= 80), 0.0])))
        detector.settle()
        (found,) = detector.changes[:1]
        assert found.direction == 1
        covered += found.since_ci95[0] <= 160.0 <= found.since_ci95[1]
        sized += found.ci95[0] < 3 * 0.8 < found.ci95[1]
    assert covered >= 36 and sized >= 34


def test_a_growing_file_is_read_line_by_line(tmp_path) -> None:
    """Each complete line counts once, a line that is half written waits, and silence ends the recording."""
    path = tmp_path / "run.csv"
    record().to_csv(path)
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[:9000])[:-5])
    rest = [b"".join(lines[:9000])[-5:] + b"".join(lines[9000:12000]), b"".join(lines[12000:])]

    def write_more(_) -> None:
        if rest:
            with path.open("ab") as file:
                file.write(rest.pop(0))

    parts = list(GrowingFile(path, patience_s=3, wait=write_more).read())
    assert len(parts) == 3 and np.array_equal(np.concatenate([part.t for part in parts]), record().t)
    result = watch_logs(MODEL, parts)
    assert not result.changes and result.logs == ("run.csv",)


def test_too_little_and_wrong_input_are_refused(tmp_path) -> None:
    """Logs no longer than the reference cannot answer, a short reference and a binary file to follow are refused."""
    log = record().select_time(0, 30)
    with pytest.raises(CannotAnswer, match="reference"):
        watch_logs(MODEL, [log])
    halves = [record().select_time(30 * k, 30 * (k + 1)) for k in range(2)]
    with pytest.raises(CannotAnswer, match="hold 60 s .* first 60 s are the reference"):
        watch_logs(MODEL, halves)
    with pytest.raises(InputError, match="40 s"):
        watch_logs(MODEL, [log], reference_s=10)
    with pytest.raises(InputError, match="CSV"):
        list(GrowingFile(tmp_path / "run.mcap").read())


def test_the_command_ends_with_zero_with_and_without_alarm(tmp_path, capsys) -> None:
    """An alarm is an answer: the status is 0, the result has the contract's form, the page and the screen say it."""
    MODEL.save(tmp_path / "m.yaml")
    for name, forces in (("quiet", None), ("heavy", CASES["payload"][0])):
        record(forces).to_csv(tmp_path / f"{name}.csv")
        out, page = tmp_path / "r.json", tmp_path / "r.html"
        command = [
            "watch",
            str(tmp_path / "m.yaml"),
            str(tmp_path / f"{name}.csv"),
            "--json",
            str(out),
            "--report",
            str(page),
        ]
        assert main(command) == 0
        result = json.loads(out.read_text())
        assert result["status"] == "ok" and result["false_alarm_rate_per_hour"] == 1e-4
        assert [row["what"] for row in result["alarms"]] == ([] if forces is None else ["payload"])
    assert {"since_t", "detected_t", "what", "joint", "size", "ci95", "false_alarm_rate"} <= set(result["alarms"][0])
    assert "ayload" in capsys.readouterr().out and "Watched" in page.read_text()
