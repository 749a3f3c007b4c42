"""FIGAROH: its regressor, decimation by ten as its `solve` does, base parameters by two QR decompositions, least squares.

Friction, rotor inertia and offsets are switched on. Its functions are called rather than its class, which asks for a
subclass and a YAML file a robot and takes one recording.
"""

import logging
import warnings
from types import SimpleNamespace

import numpy as np
import scipy.signal
from common import DoesNotApply, run

ASKED = {name: True for name in ("has_friction", "has_actuator_inertia", "has_joint_offset", "is_joint_torques")}
FACTOR, TOLERANCE = 10, 1e-3


def predict(case):
    if case.kind != "force":
        raise DoesNotApply("does not apply: it needs torques")
    import pinocchio as pin
    from figaroh.identification.identification_tools import relative_stdev
    from figaroh.identification.parameter import add_standard_additional_parameters, get_standard_parameters
    from figaroh.tools.qrdecomposition import QRDecomposer
    from figaroh.tools.regressor import build_regressor_basic, build_regressor_reduced, get_index_eliminate

    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    model = pin.buildModelFromXML(case.urdf)
    robot = SimpleNamespace(model=model, data=model.createData())
    asked = ASKED | {"act_idxv": list(range(model.nv))}
    standard = get_standard_parameters(model, asked) | add_standard_additional_parameters(model, asked)
    order = [case.channels.index(name) for name in model.names[1:]]

    def build(x):
        return build_regressor_basic(robot, *(x[key][:, order] for key in "qva"), asked)

    def thin(z):  # a block of rows a joint
        blocks = np.split(z, model.nv)
        return [scipy.signal.decimate(block, FACTOR, axis=0, zero_phase=True) for block in blocks]

    wide = [build(x) for x in case.train]
    gone, names = get_index_eliminate(np.concatenate(wide), standard, TOLERANCE)
    rows = [thin(build_regressor_reduced(W, gone)) for W in wide]
    right = [thin(x["tau"][:, order].T.ravel()) for x in case.train]
    W, tau = (np.concatenate([part[j] for j in range(model.nv) for part in some]) for some in (rows, right))
    solver = QRDecomposer()
    small, _, expressions, phi = solver.double_decomposition(tau, W, names)
    error = np.abs(phi) * relative_stdev(small, phi, tau) / 100
    ours = {"fv": "viscous", "fs": "coulomb"}
    found = {f"{joint}.{ours[kind]}": [value, stderr] for expression, value, stderr in zip(expressions, phi, error, strict=True)
             for kind, _, joint in [expression.partition("_")] if kind in ours and joint in case.channels}  # fmt: skip
    if case.channels == ["axis"]:
        found["axis.mass"] = [phi[0], error[0]]
    at = np.argsort(order)
    out = [
        (build_regressor_reduced(build(x), gone)[:, solver.base_indices] @ phi).reshape(model.nv, -1)[at].T
        for x in case.held
    ]
    return out, {"parameters": found}


if __name__ == "__main__":
    run("figaroh", predict)
