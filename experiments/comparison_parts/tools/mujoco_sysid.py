"""mujoco.sysid: windows of the recording are simulated from measured states, parameters fitted to positions and speeds.

Bodies have all ten numbers, joints armature, damping and dry friction. Forces are then those of MuJoCo's inverse. Servos are
position actuators with a gain, their bodies have mass and centre. A robot file without masses starts from guesses.
"""

from xml.etree import ElementTree

import mujoco
import numpy as np
import scipy.signal
from common import DoesNotApply, run
from mujoco import sysid

RATE_HZ, WINDOWS, ITERATIONS, MOVING = 500.0, 20, 8, 0.05
WINDOW_S = {"force": 0.25, "servo": 1.0}
LEAST_KG, LEAST_KGM2 = 1e-3, 1e-4  # a lighter body starts from the guess
GUESS = """<inertial><mass value="10"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>"""


def build_spec(case, dt, name):
    root = ElementTree.fromstring(case.urdf)
    moved = {joint.find("child").get("link") for joint in root.findall("joint") if joint.get("type") != "fixed"}
    for link in root.findall("link"):
        mass = link.find("inertial/mass")
        if link.get("name") in moved and (mass is None or float(mass.get("value")) < LEAST_KG):
            for given in link.findall("inertial"):
                link.remove(given)
            link.append(ElementTree.fromstring(GUESS))
        for inertia in link.findall("inertial/inertia"):  # a point mass does not compile
            inertia.attrib |= {
                k: x if float(x) > LEAST_KGM2 else str(LEAST_KGM2) for k, x in inertia.items() if k[1] == k[2]
            }
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    spec.compile()
    spec = mujoco.MjSpec.from_string(spec.to_xml())
    spec.option.timestep, spec.modelname = dt, name
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT
    for joint in case.channels:
        actuator = spec.add_actuator(name=f"{joint}_motor", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if case.kind == "servo":
            actuator.set_to_position(kp=5.0)
        for kind, sort in (("pos", mujoco.mjtSensor.mjSENS_JOINTPOS), ("vel", mujoco.mjtSensor.mjSENS_JOINTVEL)):
            spec.add_sensor(name=f"{joint}_{kind}", type=sort, objname=joint, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    return spec


def build_parameters(case, spec):
    params, model = sysid.ParameterDict(), spec.compile()
    kind = sysid.InertiaType.Pseudo if case.kind == "force" else sysid.InertiaType.MassIpos
    for body in range(1, model.nbody if not case.fixed else 0):
        name = model.body(body).name
        params.add(
            sysid.body_inertia_param(
                spec, model, name, inertia_type=kind, modifier=lambda s, p, n=name: set_body(s, n, p)
            )
        )
    inertia = np.array([float(np.abs(model.body_inertia).max()) + 1e-3] * len(case.channels))
    size = np.array([np.sqrt(np.mean(np.concatenate([x["tau"] for x in case.train])[:, k] ** 2)) if case.kind == "force" else 1.0
                     for k in range(len(case.channels))])  # fmt: skip
    for k, joint in enumerate(case.channels):
        for name, start, most in (("armature", 0.1 * inertia[k], 100 * inertia[k]), ("damping", 0.1 * size[k], 20 * size[k]),
                                  ("frictionloss", 0.1 * size[k], 2 * size[k])):  # fmt: skip
            params.add(sysid.Parameter(f"{joint}_{name}", start, 0.0, most,
                                       modifier=lambda s, p, j=joint, n=name: set_joint(s.joint(j), n, p.value[0])))  # fmt: skip
        if case.kind == "servo":
            params.add(
                sysid.Parameter(
                    f"{joint}_kp", 1.0, 0.01, 100.0, modifier=lambda s, p, j=joint: set_gain(s, j, p.value[0])
                )
            )
    return params


def set_body(spec, name, param):
    sysid.apply_body_inertia(spec, name, param)
    if np.isnan(spec.body(name).iquat).any():  # as mujoco 4.0 leaves it, the compiler finds no inertia
        spec.body(name).iquat = [1, 0, 0, 0]


def set_joint(joint, name, value):
    setattr(joint, name, np.array([value, 0, 0]) if np.ndim(getattr(joint, name)) else value)


def set_gain(spec, joint, value):
    actuator = spec.actuator(f"{joint}_motor")
    value *= get_gain(spec.modelname)
    actuator.gainprm[0], actuator.biasprm[1] = value, -value


def get_gain(name):
    return float(name.split("_")[0][2:]) / 100 if name.startswith("kp") else 1.0


def cut(case, spec_of):
    """Return a `ModelSequences` a log name's gain, of windows with their measured start."""
    made = {}
    total = sum(x["t"][-1] - x["t"][0] for x in case.train)
    for name, x in zip(
        case.train_names if case.kind == "servo" else ["log"] * len(case.train), case.train, strict=True
    ):
        t = np.arange(x["t"][0], x["t"][-1], spec_of(name).option.timestep)
        if case.kind == "force":
            drive, q, v = (np.stack([np.interp(t, x["t"], y) for y in x[key].T], axis=1) for key in ("tau", "q", "v"))
        else:
            rate = (len(x["t"]) - 1) / (x["t"][-1] - x["t"][0])
            smooth = scipy.signal.sosfiltfilt(scipy.signal.butter(4, 8.0, fs=rate, output="sos"), x["target"], axis=0)
            q = np.stack([np.interp(t, x["t"], y) for y in smooth.T], axis=1)
            v, drive = np.gradient(q, t, axis=0), x["cmd"][np.searchsorted(x["t"], t, side="right") - 1]
        n = int(WINDOW_S[case.kind] / (t[1] - t[0]))
        count = max(1, round(WINDOWS * (x["t"][-1] - x["t"][0]) / total))
        on = np.interp(t, x["t"], x.get("torque_enable", np.ones(len(x["t"])))) > 0.99
        moves = np.sqrt(np.array([np.mean(v[k : k + n] ** 2, axis=0) for k in range(0, len(t) - n, n)]))
        chosen = np.flatnonzero(
            (moves > MOVING * moves.max(axis=0)).all(axis=1)
        )  # a joint at rest makes the weights infinite
        for start in n * chosen[np.linspace(0, len(chosen) - 1, min(count, len(chosen))).astype(int)]:
            part = slice(start, start + n)
            if on[part].all():
                made.setdefault(name.split("_")[0], (spec_of(name), []))[1].append(
                    (t[part] - t[start], drive[part], q[part], v[part])
                )
    groups = []
    for name, (spec, windows) in made.items():
        model = spec.compile()
        order = [model.joint(i).name for i in range(model.njnt)]
        at = [case.channels.index(j) for j in order]
        starts = [sysid.create_initial_state(model, q[0, at], v[0, at], np.zeros(0)) for _, _, q, v in windows]
        control = [sysid.TimeSeries(t, drive) for t, drive, _, _ in windows]
        both = [np.stack([q, v], axis=2).reshape(len(q), -1) for _, _, q, v in windows]
        seen = [sysid.TimeSeries.from_names(t, z, model) for (t, *_), z in zip(windows, both, strict=True)]
        groups.append(
            sysid.ModelSequences(name, spec, [f"{name}{k}" for k in range(len(windows))], starts, control, seen)
        )
    return groups


def predict(case):
    if case.kind == "vibration":
        raise DoesNotApply("does not apply: it fits a MuJoCo model")
    rates = [(len(x["t"]) - 1) / (x["t"][-1] - x["t"][0]) for x in case.train]
    dt = 1 / min(RATE_HZ, max(rates)) if case.kind == "force" else 1 / RATE_HZ
    specs = {}
    groups = cut(case, lambda name: specs.setdefault(name.split("_")[0], build_spec(case, dt, name)))
    params = build_parameters(case, groups[0].spec)
    residual = sysid.build_residual_fn(models_sequences=groups)
    found, result = sysid.optimize(params, residual, verbose=False, max_iters=ITERATIONS)
    values = {name: float(found[name].value[0]) for name in found.keys() if not name.endswith("_inertia")}
    _, half = sysid.calculate_intervals(residual(found.as_vector(), found)[0], np.asarray(result.jac))
    spread = dict(zip(list_scalars(found), half, strict=True))
    told = {f"{j}.{ours}": [values[f"{j}_{kind}"], spread[f"{j}_{kind}"] / 1.96]
            for j in case.channels for ours, kind in (("coulomb", "frictionloss"), ("viscous", "damping"))}  # fmt: skip
    if case.channels == ["axis"]:
        told["axis.mass"] = [float(np.exp(2 * found["carriage_link_inertia"].value[0])) + values["axis_armature"], None]
    forecast = forecast_forces if case.kind == "force" else forecast_positions
    return forecast(case, found, lambda name: build_spec(case, dt, name)), {
        "parameters": told,
        "note": f"{ITERATIONS} iterations",
    }


def list_scalars(params):
    return [
        name if params[name].size == 1 else f"{name}{k}" for name in params.keys() for k in range(params[name].size)
    ]


def forecast_forces(case, params, spec_of):
    model, out = sysid.apply_param_modifiers(params, spec_of("log")), []
    data, at = mujoco.MjData(model), [model.joint(j).dofadr[0] for j in case.channels]
    for x in case.held:
        path = []
        for q, v, a in zip(x["q"], x["v"], x["a"], strict=True):
            data.qpos[at], data.qvel[at], data.qacc[at] = q, v, a
            mujoco.mj_inverse(model, data)
            path.append(data.qfrc_inverse[at].copy())
        out.append(np.array(path))
    return out


def forecast_positions(case, params, spec_of):
    out = []
    for name, x in zip(case.held_names, case.held, strict=True):
        model = sysid.apply_param_modifiers(params, spec_of(name))
        data, at = mujoco.MjData(model), [model.joint(j).qposadr[0] for j in case.channels]
        data.qpos[at] = x["start"]
        on, gains, path = x.get("torque_enable", np.ones(len(x["t"]))) > 0, model.actuator_gainprm.copy(), []
        bias = model.actuator_biasprm.copy()
        for k, now in enumerate(x["t"] - x["t"][0]):
            while data.time < now - 1e-9:
                data.ctrl[:] = x["cmd"][max(k - 1, 0)]
                model.actuator_gainprm[:], model.actuator_biasprm[:] = (
                    gains * on[max(k - 1, 0)],
                    bias * on[max(k - 1, 0)],
                )
                mujoco.mj_step(model, data)
            path.append(data.qpos[at].copy())
        out.append(np.array(path))
    return out


if __name__ == "__main__":
    run("mujoco", predict)
