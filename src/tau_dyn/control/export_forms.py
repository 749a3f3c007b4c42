"""Mechanisms on expressions: the closed form of the simplified Gantry-Tau as it stands, trees and loops by `export_tree.py`.

Each stands in for the mechanism of a model, so that the feedforward and the effects run on it unchanged.
"""

# ruff: noqa: D102 (what cannot be traced says so in the sentence that it raises)

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tau_dyn.control.export_loops import Loops
from tau_dyn.control.export_tree import Tree
from tau_dyn.control.expression_arrays import as_expression_array
from tau_dyn.control.graph import Graph
from tau_dyn.mechanism import GantryTauMechanism, Mechanism
from tau_dyn.model import Model


class _Kinematics(NamedTuple):
    rods: np.ndarray
    inverse: np.ndarray
    J: np.ndarray
    tool_acceleration: np.ndarray


class ClosedForm(GantryTauMechanism):
    """The simplified Gantry-Tau on expressions."""

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def _kinematics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> Any:
        """Return the same as the arrays' code, whose buffers of floats hold no expressions: `D T'' = b a - |T' - e v|^2`."""
        D = as_expression_array(self._rods(q, self._trilaterate(q)))
        along, inverse = np.einsum("nij,ij->ni", D, self.direction), np.linalg.inv(D)
        J = inverse * along[:, None, :]
        relative = (J @ v[0])[:, None, :] - v[:, :, None] * self.direction
        gained = along * a - np.sum(relative**2, axis=2)
        return _Kinematics(D, inverse, J, np.einsum("nij,nj->ni", inverse, gained))

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample from mass matrix and bias."""
        M, h = self.mass_and_bias(q[0], v[0])
        return as_expression_array((M @ a[0] + h)[None])


class TreeForm(Mechanism):
    """A tree without loops on expressions."""

    def __init__(self, model: Model) -> None:
        """Read the tree at the values of the model's parameters."""
        super().__init__(model.robot)
        self.tree = Tree(model.robot)
        self.order = [self.tree.index(name) for name in model.robot.actuated]

    def _checked(self, *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        return arrays

    def _forces(self, q: Any, v: Any, a: Any) -> tuple[list[Any], list[np.ndarray]]:
        many = [[x[0][self.order.index(k)] for k in range(len(self.order))] for x in (q, v, a)]
        tau, beyond = self.tree.forces(*many)
        return [tau[k] for k in self.order], [beyond[k] for k in self.order]

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample, drive inertia included."""
        drive = [self.tree.armature[name] for name in self.robot.actuated]
        return as_expression_array([[x + m * y for x, m, y in zip(self._forces(q, v, a)[0], drive, a[0], strict=True)]])

    def guide_load(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return what each guide or reducer carries (1, na); see `Mechanism.guide_load`."""
        tau, beyond = self._forces(q, v, a)
        load = []
        for k, place in enumerate(self.order):
            u = self.tree.joints[place].axis
            across = beyond[k] - u * (u @ beyond[k])
            load.append(across @ across if self.tree.joints[place].slides else tau[k])
        rooted = [np.sqrt(as_expression_array([x]))[0] if self.tree.joints[p].slides else abs(x)
                  for x, p in zip(load, self.order, strict=True)]  # fmt: skip
        return as_expression_array([rooted])

    def passive_rates(self, q: np.ndarray) -> tuple[tuple[str, ...], np.ndarray]:
        """Return no bearings: there are no loops."""
        return (), as_expression_array(np.zeros((1, 0, 3, self.robot.na)))

    def regressor(self, q, v, a):
        raise TypeError("the regressor of a tree")

    def mass_and_bias(self, q, v):
        raise TypeError("the mass matrix of a tree")

    def tool_position(self, q):
        raise TypeError("the tool's position on a tree")

    def tool_jacobian(self, q):
        raise TypeError("the tool's Jacobian on a tree")

    def cart_sensitivity(self, q):
        raise TypeError("the tool's sensitivity on a tree")

    def condition(self, q):
        raise TypeError("the conditioning of a tree")

    def guide_force(self, q, v, a):
        raise TypeError("the force that presses on each guide of a tree")


class LoopForm(TreeForm):
    """A tree with loops on expressions, its passive joints given."""

    def __init__(self, model: Model, loops: Loops, graph: Graph, passive: Any) -> None:
        """Take the passive joints' positions as expressions."""
        super().__init__(model)
        self.loops, self.graph, self.passive = loops, graph, passive

    def inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return the forces (1, na) of one sample: the passive joints' motion, the tree's forces, virtual work."""
        loops, graph = self.loops, self.graph
        place = loops.full(q[0], self.passive)
        J = loops.closure(place).jacobian[loops.rows]
        J_a, factor = J[:, loops.active], graph.factored(J[:, loops.passive])
        speeds = loops.rates(v[0], graph.solved(factor, -(J_a @ v[0])))
        drift = loops.closure(place, speeds).drift[loops.rows]
        change = loops.rates(a[0], graph.solved(factor, -(J_a @ a[0] + drift)))
        tau, _ = self.tree.forces(place, speeds, change)
        held = np.array(graph.solved(factor, [tau[k] for k in loops.passive], transposed=True), dtype=object)
        driven = [self.tree.armature[n] * x for n, x in zip(self.robot.actuated, a[0], strict=True)]
        felt = np.array([tau[k] for k in loops.active], dtype=object) - J_a.T @ held + np.array(driven, dtype=object)
        return as_expression_array(felt[None])

    def guide_load(self, q, v, a):
        raise TypeError("what its guides carry, on a robot whose loops are solved numerically")

    def passive_rates(self, q):
        raise TypeError("passive joints' friction, on a robot whose loops are solved numerically")


@dataclass(frozen=True, eq=False)
class TracedModel(Model):
    """A model whose mechanism is another one's tracing."""

    stand_in: Mechanism | None = None

    @property
    def mechanism(self) -> Mechanism:  # type: ignore[override]
        """Return the stand-in."""
        assert self.stand_in is not None
        return self.stand_in
