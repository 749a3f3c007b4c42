r"""The closed loops solved: from actuated positions, speeds and accelerations to those of the whole tree.

A loop k says that two points of the tree coincide, `c_k(q) = p_A(q) - p_B(q) = 0`. With `J_c = dc/dv_tree`, split into
actuated and passive columns,

    v_tree = G v_a,   G = [1; -J_p^+ J_a],   a_tree = G a_a + g_0,   g_0 = [0; -J_p^+ gamma],

where `gamma` is the constraint's acceleration at zero joint acceleration. Closure is by Newton on the passive joints,
warm-started; the first configuration is reached by continuation from the robot's home, which selects the assembly mode.
Reference: Khalil & Dombre 2002, ch. 7; Featherstone 2008, ch. 8. Pinocchio does the tree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from tau_dyn.exceptions import LoopClosureError
from tau_dyn.robot import Robot

_TOLERANCE = 1e-9  # [m] before the last step, which squares it
_WORLD = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
_STEP = 0.05  # [m or rad] largest actuated step taken at once when coming from afar


@dataclass
class TreeState:
    """One configuration of the whole tree.

    Attributes:
        q: Configuration (nq,).
        v: Velocity (nv,).
        a: Acceleration (nv,).
        G: Tree velocity per actuated velocity (nv, na).
        g0: Tree acceleration at zero actuated acceleration (nv,).
        condition: Conditioning of the passive constraint Jacobian with unit columns; 1 without loops.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    G: np.ndarray
    g0: np.ndarray
    condition: float


class LoopSolver:
    """Solves the loops of one robot, keeping the last configuration as the next one's start."""

    def __init__(self, robot: Robot, model: pin.Model | None = None) -> None:
        """Prepare for a robot; `model` may carry other masses, its kinematics must be the robot's."""
        self.robot = robot
        self.model = model if model is not None else robot.model
        self.data = self.model.createData()
        self.active_v, self._active_q = robot.active_v, robot.active_q
        self.passive_v = np.setdiff1d(np.arange(self.model.nv), self.active_v)
        self._one_number = np.array([self.model.joints[self.model.getJointId(j)].nq == 1 for j in robot.actuated])
        self._identity = np.zeros((self.model.nv, robot.na))
        self._identity[self.active_v, range(robot.na)] = 1.0
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def close(self, q_a: np.ndarray) -> np.ndarray:
        """Return the tree's configuration (nq,) that closes all loops at actuated positions `q_a` (na,).

        Raises:
            LoopClosureError: No closure was found on the way from home; the robot cannot reach these positions.
        """
        q_a = np.asarray(q_a, float)
        if not self.robot.loops:
            return self._with_active(pin.neutral(self.model), q_a)
        if self._last is not None and np.max(np.abs(q_a - self._last[0])) <= _STEP:
            q = self._newton(self._with_active(self._last[1], q_a))
            if q is not None:
                self._last = (q_a.copy(), q)
                return q
        q = self._from_home(q_a)
        self._last = (q_a.copy(), q)
        return q

    def state(self, q_a: np.ndarray, v_a: np.ndarray, a_a: np.ndarray) -> TreeState:
        """Return the tree's motion at one sample of actuated motion, each (na,)."""
        q = self.close(q_a)
        v_a, a_a = np.asarray(v_a, float), np.asarray(a_a, float)
        if not self.robot.loops:
            G, g0, condition = self._identity, np.zeros(self.model.nv), 1.0
            return TreeState(q, G @ v_a, G @ a_a, G, g0, condition)
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        jacobian = self._jacobian()
        J_p = jacobian[:, self.passive_v]
        scale = np.linalg.norm(J_p, axis=0)
        scale[scale == 0] = 1.0
        u, s, vt = np.linalg.svd(J_p / scale, full_matrices=False)
        keep = s > 1e-10 * s[0]  # a rod's free spin has no influence on anything we report: least norm
        inverse = (vt[keep].T / s[keep]) @ u[:, keep].T / scale[:, None]
        G = self._identity.copy()
        G[self.passive_v] = -inverse @ jacobian[:, self.active_v]
        v = G @ v_a
        g0 = np.zeros(self.model.nv)
        g0[self.passive_v] = -inverse @ self._acceleration_at_rest(q, v)
        condition = float(s[0] / s[-1]) if keep.all() else np.inf
        return TreeState(q, v, G @ a_a + g0, G, g0, condition)

    def closure_error(self, q: np.ndarray) -> float:
        """Return the largest distance between two points that should coincide [m]."""
        pin.framesForwardKinematics(self.model, self.data, q)
        return float(np.max(np.abs(self._gap()))) if self.robot.loops else 0.0

    def _with_active(self, q: np.ndarray, q_a: np.ndarray) -> np.ndarray:
        q = q.copy()
        index, single = self._active_q, self._one_number
        q[index[single]] = q_a[single]
        q[index[~single]], q[index[~single] + 1] = np.cos(q_a[~single]), np.sin(q_a[~single])
        return q

    def _from_home(self, q_a: np.ndarray) -> np.ndarray:
        """Walk from home to `q_a` in small steps, so that the assembly mode is home's."""
        home = self.robot.home
        q = self._newton(self._with_active(pin.neutral(self.model), home))
        if q is None:
            raise LoopClosureError(f"{self.robot.source}: the loops cannot be closed at home {self._listed(home)}")
        steps = int(np.ceil(np.max(np.abs(q_a - home)) / _STEP))
        if steps > 2000:
            raise LoopClosureError(
                f"{self.robot.source}: {self._listed(q_a)} is far outside the robot; positions must be in m and rad"
            )
        for share in np.linspace(0, 1, steps + 1)[1:]:
            q = self._newton(self._with_active(q, home + share * (q_a - home)))
            if q is None:
                raise LoopClosureError(
                    f"{self.robot.source}: the loops cannot be closed at {self._listed(q_a)}: out of reach"
                )
        return q

    def _newton(self, q: np.ndarray) -> np.ndarray | None:
        step = np.zeros(self.model.nv)
        for _ in range(30):
            pin.computeJointJacobians(self.model, self.data, q)
            pin.updateFramePlacements(self.model, self.data)
            gap = self._gap()
            J_p = self._jacobian()[:, self.passive_v]
            change = -np.linalg.lstsq(J_p, gap, rcond=1e-10)[0]
            largest = np.max(np.abs(change), initial=0.0)
            if not np.isfinite(largest):
                return None
            step[self.passive_v] = change * min(1.0, 0.5 / max(largest, 1e-300))
            q = pin.integrate(self.model, q, step)
            if np.max(np.abs(gap)) < _TOLERANCE:
                return q
        return q if np.max(np.abs(gap)) < 1e-10 else None

    def _gap(self) -> np.ndarray:
        oMf = self.data.oMf
        return np.concatenate([oMf[k.frame_a].translation - oMf[k.frame_b].translation for k in self.robot.loops])

    def _jacobian(self) -> np.ndarray:
        get = pin.getFrameJacobian
        m, d = self.model, self.data
        return np.concatenate(
            [get(m, d, k.frame_a, _WORLD)[:3] - get(m, d, k.frame_b, _WORLD)[:3] for k in self.robot.loops]
        )

    def _acceleration_at_rest(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(self.model, self.data, q, v, np.zeros(self.model.nv))
        get = pin.getFrameClassicalAcceleration
        m, d = self.model, self.data
        return np.concatenate(
            [(get(m, d, k.frame_a, _WORLD) - get(m, d, k.frame_b, _WORLD)).linear for k in self.robot.loops]
        )

    def _listed(self, q_a: np.ndarray) -> str:
        pairs = zip(self.robot.actuated, q_a, self.robot.position_units, strict=True)
        return ", ".join(f"{j} = {x:.4g} {unit}" for j, x, unit in pairs)
