"""tau_dyn with default options: `diagnose` for forces and servos, `find_modes` for vibration; the recommended model predicts."""

import numpy as np
from common import run

import tau_dyn as td


def force(case):
    robot = td.load_robot(case.folder / "robot.urdf", actuated=case.channels)
    logs = read_logs(case)
    try:
        found = td.diagnose(robot, logs)
        model, said = (
            found.extended_model if found.recommendation == "extended" else found.model,
            describe(found, found.model),
        )
    except td.CannotAnswer as reason:
        model = td.identify(robot, logs).model
        said = {"note": f"diagnose cannot answer, identify does: {reason}"[:160], "parameters": get_values(model)}
        if any(
            name.startswith("q_link_") for name in logs[0].channels
        ):  # encoders behind the gears have a diagnosis of their own
            from tau_dyn.diagnose.pipeline import diagnose_deflection

            said["causes"] = list_causes(diagnose_deflection(robot, logs))
    return [model.torque(x["q"], x["v"], x["a"], t=x["t"]) for x in case.held], said


def servo(case):
    from tau_dyn.servo import diagnose_loop, identify_loop
    from tau_dyn.servo.loads import InertialSpace
    from tau_dyn.servo.prediction import simulate_coupled
    from tau_dyn.servo.records import build_records
    from tau_dyn.servo.simulation import read_values
    from tau_dyn.simulate import build_servo_law, read_servo_law

    robot, logs = td.load_robot(case.folder / "robot.urdf", actuated=case.channels), read_logs(case)
    law = read_servo_law(case.folder / "law.yaml", robot)
    given = {"law": law, "choices": td.Choices(fix=tuple(case.fixed))}
    found = diagnose_loop(robot, logs, **given)
    model = found.extended_model if found.recommendation == "extended" else identify_loop(robot, logs, **given).model
    law, out = build_servo_law(dict(model.controller), robot, "the model"), []
    for name, x in zip(case.held_names, case.held, strict=True):
        columns = {f"cmd_{j}": x["cmd"][:, k] for k, j in enumerate(case.channels)}
        columns |= {f"q_{j}": np.full(len(x["t"]), x["start"][k]) for k, j in enumerate(case.channels)}
        columns |= {key: x[key] for key in ("torque_enable", "input_volts") if key in x}
        records = build_records(model, law, [td.Log(x["t"], columns, name)])
        q = simulate_coupled(InertialSpace.of(model), np.zeros(0), read_values(model, law), law, records)[0].q
        out.append(np.stack([np.interp(x["t"], records[0].t, y) for y in q.T], axis=1))
    return out, describe(found, model)


def vibration(case):
    from tau_dyn.modes.record import Record, estimate_operating_point
    from tau_dyn.modes.state_space import delay_inputs, estimate_initial_state

    (x,), (h,) = case.train, case.held
    found = td.find_modes(read_logs(case), case.inputs, case.channels)
    names = (1.0, tuple(case.inputs), tuple(case.channels))
    u0, y0 = estimate_operating_point(Record(x["u"], x["target"], *names))
    train, m = Record(x["u"] - u0, x["target"] - y0, *names), found.model
    state = estimate_initial_state(m, train, predictor=True)
    whole = Record(np.concatenate([x["u"], h["u"]]) - u0, np.zeros((len(x["u"]) + len(h["u"]), len(y0))), *names)
    drives = delay_inputs(m, whole)
    for u, y in zip(drives, train.y, strict=False):  # the innovation form follows the training data to their end
        state = m.A @ state + m.B @ u + m.K @ (y - m.C @ state - m.D @ u)
    out = []
    for u in drives[len(train.y) :]:
        out.append(m.C @ state + m.D @ u)
        state = m.A @ state + m.B @ u
    said = {
        "note": f"order {found.order}",
        "warnings": list(found.warnings),
        "free": {"A": m.A.tolist(), "C": m.C.tolist()},
    }
    return [np.array(out) + y0], said


def read_logs(case):
    return [td.read_log(case.folder / "logs" / f"{name}.csv") for name in case.train_names]


def list_causes(found):
    return sorted({f.cause for f in found.findings if f.status == "confirmed"})


def get_values(model):
    values = {p.name: [p.value, p.stderr] for p in model.parameters}
    for joint in model.robot.actuated:
        for kind in ("coulomb", "viscous"):
            two = [values.get(f"{joint}.{kind}_{way}") for way in ("pos", "neg")]
            if all(two):
                values[f"{joint}.{kind}"] = [
                    np.mean([x for x, _ in two]),
                    0.5 * np.hypot(*[s or np.nan for _, s in two]),
                ]
    return values | ({"axis.mass": values["carriage_link.mass"]} if "carriage_link.mass" in values else {})


def describe(found, model):
    return {"note": f"{found.verdict}, {found.recommendation}", "causes": list_causes(found), "parameters": get_values(model),
            "unexplained": sorted({x.joint for x in found.unexplained}), "warnings": list(found.warnings)}  # fmt: skip


if __name__ == "__main__":
    run("tau-dyn", lambda case: {"force": force, "servo": servo, "vibration": vibration}[case.kind](case))
