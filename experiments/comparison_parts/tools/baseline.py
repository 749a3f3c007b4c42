"""The textbook in forty lines: least squares on base parameters, rotor inertia, Coulomb and viscous friction, and an offset.

Servos: joint by joint, `q'' = a (cmd - q) + b q' + c sign q' + d sin q + e cos q + f`. Vibration: an ARX model of order 8.
"""

import numpy as np
import scipy.linalg
import scipy.signal
from common import run

ORDER, FORCE_HZ, REST = 8, 20.0, 0.03  # samples, Hz, rad/s


def regressor(case, x):
    import pinocchio as pin

    model = pin.buildModelFromXML(case.urdf)
    data, at = model.createData(), [model.joints[model.getJointId(j)].idx_v for j in case.channels]
    q, v, a = (np.zeros((len(x["t"]), model.nv)) for _ in "qva")
    q[:, at], v[:, at], a[:, at] = x["q"], x["v"], x["a"]
    bodies = np.array(
        [
            np.reshape(pin.computeJointTorqueRegressor(model, data, *row), (model.nv, -1))[at]
            for row in zip(q, v, a, strict=True)
        ]
    )
    own = [np.einsum("nj,jk->njk", y, np.eye(len(at))) for y in (x["a"], np.sign(x["v"]), x["v"], np.ones_like(x["v"]))]
    return np.concatenate([bodies, *own], axis=2)


def force(case):
    rows, right = [], []
    for x in case.train:
        rate = 1 / np.median(np.diff(x["t"]))
        every, sos = max(1, int(rate / 100)), scipy.signal.butter(4, min(FORCE_HZ, rate / 10), fs=rate, output="sos")
        W, y = (scipy.signal.sosfiltfilt(sos, z, axis=0)[::every] for z in (regressor(case, x), x["tau"]))
        rows.append(W.reshape(-1, W.shape[2]))
        right.append(y.ravel())
    W, y = np.concatenate(rows), np.concatenate(right)
    _, R, order = scipy.linalg.qr(W, mode="economic", pivoting=True)
    base = np.sort(order[np.abs(np.diag(R)) > 1e-6 * abs(R[0, 0])])
    beta = np.linalg.lstsq(W[:, base], y, rcond=None)[0]
    error = np.sqrt(np.diag(np.linalg.inv(W[:, base].T @ W[:, base])) * np.mean((y - W[:, base] @ beta) ** 2))
    na = len(case.channels)
    names = [f"{j}.{kind}" for kind in ("armature", "coulomb", "viscous", "offset") for j in case.channels]
    found = {
        names[c - W.shape[1] + 4 * na]: [b, s]
        for c, b, s in zip(base, beta, error, strict=True)
        if c >= W.shape[1] - 4 * na
    }
    if na == 1 and case.channels[0] == "axis":
        found["axis.mass"] = [beta[0], error[0]]
    return [regressor(case, x)[:, :, base] @ beta for x in case.held], {"parameters": found}


def servo(case):
    def columns(cmd, q, v):
        return np.stack([cmd - q, v, np.tanh(v / REST), np.sin(q), np.cos(q), np.ones_like(q)], axis=-1)

    W, y = [], []
    for x in case.train:
        dt = np.median(np.diff(x["t"]))
        q = scipy.signal.sosfiltfilt(scipy.signal.butter(4, 8.0, fs=1 / dt, output="sos"), x["target"], axis=0)
        v = np.gradient(q, dt, axis=0)
        on = x.get("torque_enable", np.ones(len(q)))[:, None, None] > 0
        W.append(columns(x["cmd"], q, v) * np.where(np.arange(6) == 0, on, 1))
        y.append(np.gradient(v, dt, axis=0))
    W, y = np.concatenate(W), np.concatenate(y)
    beta = np.array([np.linalg.lstsq(W[:, k], y[:, k], rcond=None)[0] for k in range(W.shape[1])])
    out = []
    for x in case.held:
        q, v, path = x["start"].astype(float), np.zeros(len(beta)), []
        on = x.get("torque_enable", np.ones(len(x["t"]))) > 0
        for k, dt in enumerate(np.diff(x["t"], append=x["t"][-1])):
            path.append(q)
            for _ in range(20):
                v = v + dt / 20 * np.sum(columns(np.where(on[k], x["cmd"][k], q), q, v) * beta, axis=1)
                q = q + dt / 20 * v
        out.append(np.array(path))
    return out, {}


def vibration(case):
    (x,), (h,) = case.train, case.held
    u0, y0 = x["u"].mean(axis=0), x["target"].mean(axis=0)
    u, y = np.concatenate([x["u"], h["u"]]) - u0, x["target"] - y0

    def row(t, y):
        return np.concatenate([y[t - ORDER : t].ravel(), u[t - ORDER : t + 1].ravel()])

    beta = np.linalg.lstsq(np.array([row(t, y) for t in range(ORDER, len(y))]), y[ORDER:], rcond=None)[0]
    z = np.concatenate([y, np.zeros_like(h["u"][:, :1]) + np.zeros(y.shape[1])])
    for t in range(len(y), len(z)):
        z[t] = np.clip(row(t, z) @ beta, -1e6, 1e6)
    p = y.shape[1]
    C = np.concatenate([beta[k * p : (k + 1) * p].T for k in reversed(range(ORDER))], axis=1)
    A = np.concatenate([C, np.eye(p * ORDER)[: p * (ORDER - 1)]])
    return [z[len(y) :] + y0], {"note": f"ARX, order {ORDER}", "free": {"A": A.tolist(), "C": C.tolist()}}


if __name__ == "__main__":
    run("numpy", lambda case: {"force": force, "servo": servo, "vibration": vibration}[case.kind](case))
