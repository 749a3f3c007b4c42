"""SLICOT's subspace identification through ctrlsys, MOESP with N4SID, at the published order."""

import numpy as np
from common import DoesNotApply, run

HORIZON = 25


def predict(case):
    if case.kind != "vibration":
        raise DoesNotApply("does not apply: it fits linear models to inputs and outputs")
    import ctrlsys

    (x,), (h,) = case.train, case.held
    u0, y0 = x["u"].mean(axis=0), x["target"].mean(axis=0)
    u, y = np.asfortranarray(x["u"] - u0), np.asfortranarray(x["target"] - y0)
    m, p, n = u.shape[1], y.shape[1], case.order
    R = ctrlsys.ib01ad("M", "Q", "N", "O", "N", "N", HORIZON, m, p, u.copy("F"), y.copy("F"), -1.0, -1.0)[1]
    A, C, B, D, _, _, _, K, _, info = ctrlsys.ib01bd("C", "A", "K", HORIZON, n, m, p, len(u), R, -1.0)
    if info:
        raise RuntimeError(f"IB01BD: {info}")
    state, out = np.zeros(n), []
    for drive, seen in zip(u, y):  # the Kalman filter follows the training data to their end
        state = A @ state + B @ drive + K @ (seen - C @ state - D @ drive)
    for drive in h["u"] - u0:
        out.append(C @ state + D @ drive)
        state = A @ state + B @ drive
    return [np.array(out) + y0], {"note": f"order {n}"}


if __name__ == "__main__":
    run("ctrlsys", predict)
