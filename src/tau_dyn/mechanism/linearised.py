r"""What a flexible robot does near a pose: natural modes, static compliance, and a state space to simulate.

In deviations from rest, `z = [a; s]` (actuators, springs), `M z'' + D z' + K z = [tau; 0] + J_f' f`; the tool moves by `J z`.
With the actuators' motion `a(t)` given, the springs obey

    M_ss s'' + D_ss s' + K_ss s = -M_sa a'' - K_sa a + J_fs' f.

Accelerations of the input are no input one wants to log, so they are absorbed: with `F = -M_ss^-1 M_sa`, `s = F a + x1` and
`x2 = x1' + M_ss^-1 D_ss F a`,

    x1' = x2 - M_ss^-1 D_ss F a
    x2' = -M_ss^-1 (D_ss x1' + K_ss x1) + M_ss^-1 (J_fs' f - (K_sa + K_ss F) a),

which is exact. An accelerometer is a second-order low-pass on the true acceleration, which makes its signal finite even where
a drive's speed jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from tau_dyn.exceptions import InputError
from tau_dyn.mechanism.drive import PositionDrives
from tau_dyn.mechanism.linear_system import ContinuousModel
from tau_dyn.mechanism.rod_dimensions import AXES
from tau_dyn.robot import Robot


@dataclass(frozen=True, eq=False)
class NaturalMode:
    """One way a robot vibrates while its actuators stand still.

    Attributes:
        frequency_hz: Undamped natural frequency, `|s| / 2 pi`.
        damping_ratio: `-Re s / |s|`.
        springs: Deflection of each spring (ns,), complex, the largest 1.
        tool: Displacement of the tool (3,), complex, in base axes, at that deflection.
    """

    frequency_hz: float
    damping_ratio: float
    springs: np.ndarray
    tool: np.ndarray


@dataclass(frozen=True, eq=False)
class Linearised:
    """A flexible robot near one pose; made by `FlexibleModel.at`.

    Attributes:
        robot: The rigid robot.
        springs: Names of the spring joints; all matrices have the actuated joints first, then these.
        q: Actuated positions (na,).
        deflection: The springs' deflection at rest (ns,).
        M: Mass matrix (n, n).
        D: Damping matrix (n, n).
        K: Stiffness matrix (n, n), with the weight's share.
        tool: The tool's velocity per coordinate's (3, n), in base axes.
        pushed: The same of the point that outside forces act on (3, n).
        tool_position: At rest (3,) [m].
    """

    robot: Robot
    springs: tuple[str, ...]
    q: np.ndarray
    deflection: np.ndarray
    M: np.ndarray
    D: np.ndarray
    K: np.ndarray
    tool: np.ndarray
    pushed: np.ndarray
    tool_position: np.ndarray

    @property
    def na(self) -> int:
        """Number of actuated joints."""
        return len(self.q)

    def natural_frequencies(self) -> np.ndarray:
        """Return the undamped natural frequencies with the actuators held (ns,) [Hz], rising."""
        a = self.na
        values = eigh(self.K[a:, a:], self.M[a:, a:], eigvals_only=True)
        return np.sqrt(values) / (2 * np.pi)

    def modes(self) -> tuple[NaturalMode, ...]:
        """Return the damped modes with the actuators held, slowest first; what is damped beyond swinging is left out."""
        A = self._springs_alone()
        poles, vectors = np.linalg.eig(A)
        found = []
        for k in np.argsort(np.abs(poles)):
            if poles[k].imag > 1e-9 * abs(poles[k]):
                shape = vectors[: len(self.springs), k]
                shape = shape / shape[np.argmax(np.abs(shape))]
                size = abs(poles[k])
                found.append(
                    NaturalMode(
                        float(size / (2 * np.pi)), float(-poles[k].real / size), shape, self.tool[:, self.na :] @ shape
                    )
                )
        return tuple(found)

    def compliance(self) -> np.ndarray:
        """Return the tool's static displacement per outside force (3, 3) [m/N], actuators held."""
        a = self.na
        return self.tool[:, a:] @ np.linalg.solve(self.K[a:, a:], self.pushed[:, a:].T)

    def state_space(
        self, drives: PositionDrives | None = None, *, acceleration: bool = False, accelerometer_hz: float = 300.0
    ) -> ContinuousModel:
        """Return the way from actuators and outside force to actuators and tool, as deviations from rest.

        Args:
            drives: Takes references `q_ref_J` to positions `q_J`; None makes the actuators' positions `q_J` the inputs.
            acceleration: Also give the tool's acceleration as an accelerometer reads it, without gravity.
            accelerometer_hz: The accelerometer's bandwidth [Hz].

        Inputs are `q_ref_J` (or `q_J`) and `fx_tool fy_tool fz_tool` [N], outputs `q_J`, `x_tool y_tool z_tool` [m] and, if
        asked for, `ax_tool ay_tool az_tool` [m/s^2].
        """
        model = self._from_motion()
        if drives is not None:
            model = self._driven(model, drives)
        return self._with_accelerometer(model, accelerometer_hz) if acceleration else model

    def _springs_alone(self) -> np.ndarray:
        a, ns = self.na, len(self.springs)
        slope = np.linalg.solve(self.M[a:, a:], np.hstack([self.K[a:, a:], self.D[a:, a:]]))
        return np.block([[np.zeros((ns, ns)), np.eye(ns)], [-slope]])

    def _from_motion(self) -> ContinuousModel:
        """Return the springs between given actuator motion and the tool: states x1, x2."""
        a, ns = self.na, len(self.springs)
        M, D, K = self.M[a:, a:], self.D[a:, a:], self.K[a:, a:]
        F = -np.linalg.solve(M, self.M[a:, :a])
        damped = np.linalg.solve(M, D)
        A = self._springs_alone()
        push = np.linalg.solve(M, self.pushed[:, a:].T)
        by_motion = np.vstack(
            [-damped @ F, damped @ damped @ F - np.linalg.solve(M, self.K[a:, :a] + K @ F)]
        )  # x1' = x2 - M^-1 D F a, and the same inside x2'
        B = np.hstack([by_motion, np.vstack([np.zeros((ns, 3)), push])])
        C = np.vstack([np.zeros((a, 2 * ns)), np.hstack([self.tool[:, a:], np.zeros((3, ns))])])
        through = np.vstack([np.eye(a), self.tool[:, :a] + self.tool[:, a:] @ F])
        names = [f"q_{j}" for j in self.robot.actuated]
        inputs = (*names, *(f"f{x}_tool" for x in AXES))
        outputs = (*names, *(f"{x}_tool" for x in AXES))
        return ContinuousModel(A, B, C, np.hstack([through, np.zeros((a + 3, 3))]), inputs, outputs, np.zeros(a + 3))

    def _driven(self, model: ContinuousModel, drives: PositionDrives) -> ContinuousModel:
        """Return the same system behind drives: their positions become states."""
        a, n = self.na, model.order
        if len(drives.time_constants) != a:
            raise InputError(
                "mismatch", f"{len(drives.time_constants)} drive(s) for {a} actuated joint(s); give one each"
            )
        lag = np.diag(1 / np.array(drives.time_constants))
        A = np.block([[-lag, np.zeros((a, n))], [model.B[:, :a], model.A]])
        B = np.block([[lag, np.zeros((a, 3))], [np.zeros((n, a)), model.B[:, a:]]])
        C = np.hstack([model.D[:, :a], model.C])
        D = np.hstack([np.zeros((len(C), a)), model.D[:, a:]])
        inputs = (*(f"q_ref_{j}" for j in self.robot.actuated), *model.inputs[a:])
        return ContinuousModel(A, B, C, D, inputs, model.outputs, np.array([drives.delay] * a + [0.0] * 3))

    def _with_accelerometer(self, model: ContinuousModel, bandwidth_hz: float) -> ContinuousModel:
        """Return the same system with three outputs more, `w^2 s^2 / (s^2 + sqrt(2) w s + w^2)` of the tool's position."""
        if not 0 < bandwidth_hz < np.inf:
            raise InputError("invalid_value", f"an accelerometer's bandwidth must be positive, not {bandwidth_hz:g} Hz")
        w, n, m = 2 * np.pi * bandwidth_hz, model.order, len(model.inputs)
        C, D = model.C[self.na :], model.D[self.na :]
        eye, none = np.eye(3), np.zeros((3, 3))
        A = np.block(
            [
                [model.A, np.zeros((n, 6))],
                [np.zeros((3, n)), none, eye],
                [w**2 * C, -(w**2) * eye, -np.sqrt(2) * w * eye],
            ]
        )
        B = np.vstack([model.B, np.zeros((3, m)), w**2 * D])
        rows = np.vstack([np.hstack([model.C, np.zeros((len(model.C), 6))]), A[-3:]])
        outputs = (*model.outputs, *(f"a{x}_tool" for x in AXES))
        return ContinuousModel(A, B, rows, np.vstack([model.D, w**2 * D]), model.inputs, outputs, model.delay)
