"""`tau-dyn demo`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, cast

from cyclopts import Parameter

from tau_dyn.cli.arguments import Output, RobotOptions, build_destination
from tau_dyn.cli.execute import Outcome
from tau_dyn.cli.progress import show_progress
from tau_dyn.cli.run_folder import RunFolder
from tau_dyn.exceptions import InputError
from tau_dyn.files import compute_sha256

if TYPE_CHECKING:
    from tau_dyn.log import Log
    from tau_dyn.model import Model
    from tau_dyn.robot import LinkInertia, Robot

# Dressler 2012, Table 6.1: coulomb_neg, coulomb_pos [N], viscous_neg, viscous_pos [N/(m/s)] of each actuator
TABLE_6_1 = ((145.69, 189.12, 158.01, 205.03), (119.23, 262.59, 133.76, 190.00), (177.22, 239.06, 197.52, 185.94))
_QUANTITIES = ("coulomb_neg", "coulomb_pos", "viscous_neg", "viscous_pos")
RATE_HZ = 500.0
"""Rate of control and log."""
SECONDS = {"monday": 48.0, "tuesday": 32.0}
"""Length of the training and of the held-out log [s]."""
TOOTH = 0.0209
"""Distance after which cart 2's pinion repeats [m]."""
RIPPLE = 2.0
"""Amplitude of its force [N]."""
PEAK = {"cart1": 18.0, "cart2": 20.0, "cart3": 22.0}
"""Excess of friction at standstill over Coulomb friction [N], about a tenth of it; it vanishes at a few times 25 mm/s."""

MAX_PAYLOAD_KG = 2.0  # kg, two fifths of a UR5's rated payload
PAYLOAD_SHARE = 0.12  # of the arm's moving mass, the share of 2 kg in a UR5's; a small arm carries less
PAYLOAD_CENTRE = (0.02, 0.05, 0.04)
"""Centre of the arm's payload in the last joint's frame [m]."""
PAYLOAD_GYRATION_M = 0.05
"""Its radius of gyration [m], that of a gripper."""
_GEARED = {"coulomb": 0.05, "viscous": 0.05, "armature": 0.008, "stribeck": 0.035, "noise": 0.003}
"""Properties of a geared drive relative to its joint's effort limit: friction [N m] and its growth up to full speed [N m],
reflected rotor inertia [kg m2 per N m], friction's peak at standstill and torque noise [N m]; similar to a UR5's."""
_PEAK_SPEED = {"rad": 0.08, "m": 0.025}
"""Speed over which the peak falls to a third [rad/s or m/s]."""
_MASS_ERROR = 0.01
"""Largest relative error of a mass in the arm's file, about the accuracy of manufacturers' data."""
_GANTRY_MASS_ERROR = 0.1
"""The same of the Gantry-Tau's."""
_USUAL_SPEED = {"rad": 2.0, "m": 0.5}
"""Full speed if the file gives no limit, as in MJCF [rad/s or m/s]; that of common arms."""
_ENCODER = {"rad": 2e-5, "m": 5e-6}
"""Standard deviation of its positions [rad or m]: of an encoder of 17 bits, and of a linear scale."""


_FOLDER = cast(Path, RunFolder(Path("tau_dyn_demo"), beside=True))  # a command receives the folder's path


@dataclass(frozen=True)
class Made:
    """The true robot, and the effects that the fitted model lacks.

    Attributes:
        robot: The robot file.
        truth: The simulated robot.
        sensors: Its sensors, as keyword arguments.
        hidden: The hidden causes.
        said: The hidden causes in words.
        call: Name of the robot in commands.
    """

    robot: Robot
    truth: Model
    sensors: dict[str, Any]
    hidden: tuple[str, ...]
    said: str
    call: str


def demo(
    robot: str | None = None,
    /,
    *,
    out: Annotated[Path, build_destination("DIR"), Parameter(show_default=False)] = _FOLDER,
    robot_options: RobotOptions = RobotOptions(),
    output: Output = Output(),
) -> Outcome:
    """The main workflow on simulated data with hidden effects: simulate, identify, diagnose, report.

    The default robot is the L1 Gantry-Tau with the asymmetric friction of Dressler 2012, Table 6.1; the fitted model lacks the
    pinion's ripple and the Stribeck friction. With a serial arm's file, such as a stock UR5's, it is that arm with geared drives,
    a payload of up to 2 kg at its flange and Stribeck friction in one joint. Joints that do not carry the tool, such as a
    gripper's, are held still.

    Args:
        robot: The file of a serial arm, such as a UR5's (default: a Gantry-Tau)
        out: Folder (default tau_dyn_demo)
    """
    with show_progress(output.quiet) as step:
        step("loading")
        from tau_dyn.diagnose import diagnose
        from tau_dyn.identify import identify
        from tau_dyn.render import build_page
        from tau_dyn.simulate import Sensors, build_named_motion, simulate

        seed = output.seed
        made = make_arm(*load_arm(robot, robot_options), seed) if robot else make_gantry(seed)
        sensors, logs = Sensors(**made.sensors, log_rate_hz=RATE_HZ), []
        for k, (name, duration) in enumerate(SECONDS.items()):
            path = build_named_motion("fourier", made.truth, duration, seed + k)
            log = simulate(
                made.truth,
                path,
                sensors=sensors,
                rate_hz=RATE_HZ,
                seed=seed + k,
                name=f"{name}.csv",
                progress=lambda share, day=name: step(f"simulating {day}: {100 * share:.0f} %"),
            )
            logs.append(hash_log(log))
        fit = identify(made.robot, logs[0], holdout=logs[1], seed=seed, progress=step)
        found = diagnose(made.robot, logs[0], holdout=logs[1], seed=seed, progress=step)
        step("reports")
        values = {p.name: p.value for p in made.truth.parameters}
        files = f"{made.call} {out}/monday.csv --holdout {out}/tuesday.csv"
        page = build_page(found, command_line=f"tau-dyn diagnose {files}")
        plain = build_page(fit, command_line=f"tau-dyn identify {files}", truth=values)
    written = {
        "report": str(out / "report.html"),
        "extended model": str(out / "extended.yaml"),
        "identification": str(out / "identification.html"),
        "logs": str(out),
    }
    return Outcome(
        result=found.to_dict() | {"truth": values, "hidden": list(made.hidden), "out": str(out)},
        warnings=found.warnings,
        inputs=robot_options.list_files(robot) if robot else [],
        show=lambda console, _: _show(console, made, found, written),
        files={
            out / "identification.html": plain,
            out / "model.yaml": fit.model.save,
            out / "extended.yaml": found.extended_model.save,
            **{out / log.name: log.to_csv for log in logs},
        },
        report=lambda command_line: page,
    )


def hash_log(log: Log) -> Log:
    """Return a log with the hash that its file will have; models refer to logs by hash."""
    with TemporaryDirectory() as room:
        path = Path(room) / log.name
        log.to_csv(path)
        return replace(log, sha256=compute_sha256(path))


def make_gantry(seed: int) -> Made:
    """Return the L1 Gantry-Tau with a pinion's ripple on cart 2 and Stribeck friction on all carts."""
    from tau_dyn.effects import CyclicRipple, Stribeck
    from tau_dyn.robot import load_robot

    robot = load_robot("gantry_tau", prototype="l1")
    joints, units = robot.actuated, robot.force_units
    effects = (CyclicRipple(joints[1:2], units[1:2], period=TOOTH), Stribeck(joints, units, speed=0.025))
    values = {f"{joints[1]}.ripple_sin": RIPPLE, **{f"{joint}.stribeck": value for joint, value in PEAK.items()}}
    said = (
        f"a ripple of {RIPPLE:g} N every {1e3 * TOOTH:g} mm on cart2, Stribeck friction on all carts, and masses up to "
        f"{100 * _GANTRY_MASS_ERROR:g} % off the robot file's"
    )
    sensors = {"encoder_noise": 5e-6, "force_noise": 5.0}
    truth = _extend(build_true_model(robot, seed), effects, values)
    return Made(robot, truth, sensors, ("cyclic_ripple", "stribeck"), said, "gantry_tau")


def build_true_model(robot: Robot, seed: int) -> Model:
    """Return the simulated Gantry-Tau: friction of Table 6.1, and masses that differ from the nominal ones by up to 10 %."""
    import numpy as np

    rng, off = np.random.default_rng(seed), _GANTRY_MASS_ERROR
    values = {p.name: p.value * rng.uniform(1 - off, 1 + off) for p in robot.parameters if p.name.endswith(".mass")}
    for joint, row in zip(robot.actuated, TABLE_6_1, strict=True):
        values |= {f"{joint}.{quantity}": value for quantity, value in zip(_QUANTITIES, row, strict=True)}
    return _extend(_with_friction(robot), (), values)


def load_arm(robot: str, options: RobotOptions) -> tuple[Robot, str]:
    """Return the robot with only the joints actuated that carry its tool, and its name in commands.

    Raises:
        InputError: The robot has loops, or no joint carries its tool.
    """
    arm = options.load(robot)
    if arm.loops:
        raise InputError("unsupported", f"{robot}: the demo takes serial arms, or no robot for its own Gantry-Tau")
    carrying = arm.carrying_joints
    if not carrying:
        missing = f"no joint carries {arm.tool}" if arm.tool else "several arms begin at its base"
        raise InputError("bad_option", f"{robot}: {missing}; name the last link of an arm with --tool")
    if not arm.tool:  # the payload is attached to the tool frame
        last = next(link for link in reversed(arm.links) if arm.model.names[link.joint_id] in carrying)
        options = replace(options, tool=last.link)
        arm = options.load(robot)
    said = [str(robot), *(f"--set {text}" for text in options.set), *(f"--package {text}" for text in options.package)]
    said += [f"--tool {options.tool}"] if options.tool else []
    if options.actuated:
        said.append(f"--actuated {' '.join(options.actuated)} --")
    elif len(carrying) < arm.na:  # the logs lack the other joints, so that no command requires them
        arm = replace(options, actuated=carrying).load(robot)
    return arm, " ".join(said)


def make_arm(robot: Robot, call: str, seed: int) -> Made:
    """Return a serial arm with geared drives, a payload on its last link and Stribeck friction in its third joint or its last.

    Raises:
        InputError: The robot has no effort limits to scale its drives by.
    """
    import numpy as np

    from tau_dyn.effects import Stribeck
    from tau_dyn.robot import NOT_GIVEN

    effort, speed = np.abs(robot.effort_limit), np.abs(robot.velocity_limit)
    usual = np.array([_USUAL_SPEED[unit] for unit in robot.position_units])
    speed = np.where(np.isfinite(speed) & (speed > 0), speed, usual)
    if not (np.isfinite(effort).all() and (effort > 0).all()):
        raise InputError(
            "unsupported", f"{call}: the demo scales drives by each joint's effort limit; the file lacks some"
        )
    rng = np.random.default_rng(seed)
    values: dict[str, float] = {}
    for link in robot.links:
        factor = rng.uniform(1 - _MASS_ERROR, 1 + _MASS_ERROR)
        values |= {name: factor * robot.parameters[name].value for name in link.names}
    for joint, limit, fast in zip(robot.actuated, effort, speed, strict=True):
        rough = limit * rng.uniform(0.8, 1.2, 4) * (np.array([1, 1, 1 / fast, 1 / fast]) * _GEARED["coulomb"])
        values |= {f"{joint}.{quantity}": float(x) for quantity, x in zip(_QUANTITIES, rough, strict=True)}
        armature = robot.parameters[f"{joint}.armature"]
        values[armature.name] = float(_GEARED["armature"] * limit) if armature.origin == NOT_GIVEN else armature.value
    carrier = next(link for link in reversed(robot.links) if robot.model.names[link.joint_id] in robot.actuated)
    payload = round(min(MAX_PAYLOAD_KG, PAYLOAD_SHARE * sum(link.nominal[0] for link in robot.links)), 3)
    values |= _with_payload(carrier, payload, values)
    stiff = min(2, robot.na - 1)
    joint, peak = robot.actuated[stiff], float(_GEARED["stribeck"] * effort[stiff])
    values[f"{joint}.stribeck"] = peak
    unit = robot.force_units[stiff]
    effect = Stribeck((joint,), (unit,), speed=_PEAK_SPEED[robot.position_units[stiff]])
    centre = ", ".join(f"{x:g}" for x in PAYLOAD_CENTRE)
    said = (
        f"a payload of {payload:g} kg at ({centre}) m in the frame of {robot.model.names[carrier.joint_id]}, Stribeck "
        f"friction of {peak:.3g} {unit} in {joint}, and masses up to {100 * _MASS_ERROR:g} % off the robot file's"
    )
    encoder = [_ENCODER[unit] for unit in robot.position_units]
    sensors = {"encoder_noise": encoder, "force_noise": (_GEARED["noise"] * effort).tolist(), "tool": False}
    return Made(robot, _extend(_with_friction(robot), (effect,), values), sensors, ("payload", "stribeck"), said, call)


def _with_payload(link: LinkInertia, mass: float, values: dict[str, float]) -> dict[str, float]:
    """Return a link's ten inertial parameters with those of a payload of this mass [kg] added (Huygens-Steiner)."""
    import numpy as np

    names, c = link.names, np.array(PAYLOAD_CENTRE)
    about = mass * (PAYLOAD_GYRATION_M**2 * np.eye(3) + (c @ c) * np.eye(3) - np.outer(c, c))
    more = [mass, *(mass * c), *(about[i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))]
    return {name: values[name] + float(x) for name, x in zip(names, more, strict=True)}


def _with_friction(robot: Robot) -> Model:
    """Return the robot with asymmetric friction at zero."""
    from tau_dyn.effects import build_friction_model
    from tau_dyn.model import Model

    return Model.of(robot, build_friction_model("asymmetric", robot.actuated, robot.force_units))


def _extend(model: Model, effects: Sequence, values: dict[str, float]) -> Model:
    """Return the model with further effects at these values."""
    from tau_dyn.parameters import Parameters

    more = Parameters([p for effect in effects for p in effect.parameters])
    model = replace(model, effects=(*model.effects, *effects), effect_parameters=model.effect_parameters + more)
    return model.with_values(values)


def _show(console, made: Made, found, written: dict[str, str]) -> None:
    from tau_dyn.render import print_result, say

    print_result(console, found, written)
    claims = " ".join(f.sentence for f in found.findings if f.status in ("confirmed", "parameter"))
    say(console, f"Hidden in the made logs: {made.said}.")
    say(console, f"Found: {claims.replace('+-', '±') or 'nothing.'}")
