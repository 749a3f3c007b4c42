"""What `find_operational_modes` found: modes without a scale, and the diagram that they were taken from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tau_dyn.modes.modal import Mode
from tau_dyn.modes.stabilisation import StabilityPoint
from tau_dyn.results import Shown

REASON_WITHOUT_SCALE = (
    "the forces were not measured, so responses have no scale: modal masses, M, D, K and a model from input to output "
    "do not follow"
)


@dataclass(frozen=True, eq=False)
class OperationalModes(Shown):
    """The answer of `find_operational_modes`.

    Attributes:
        outputs: Columns that respond.
        dt: Sampling step [s].
        order: Highest order of model.
        modes: Modes of the structure, slowest first; shapes are relative to their largest output.
        stabilisation: Modes of all orders.
        n_samples: Samples used.
        warnings: What is doubtful, one sentence each.
        seed: Kept with the result; nothing here is random.
    """

    outputs: tuple[str, ...]
    dt: float
    order: int
    modes: tuple[Mode, ...]
    stabilisation: tuple[StabilityPoint, ...]
    n_samples: int
    warnings: tuple[str, ...] = ()
    seed: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON result; what responses alone cannot give is null, with the reason."""
        return {
            "order": self.order,
            "delay_samples": None,
            "method": "ssi-cov",
            "dt": self.dt,
            "inputs_used": [],
            "outputs_used": list(self.outputs),
            "kind": "operational",
            "modes": [mode.to_dict(self.outputs) for mode in self.modes],
            "fit_percent": {"train": None, "holdout": None},
            "residual_tests": None,
            "mdk": {
                "status": "not_identifiable",
                **dict.fromkeys(("M", "D", "K", "stderr", "valid_hz")),
                "why": REASON_WITHOUT_SCALE,
            },
            "stabilisation": [p.to_dict() for p in self.stabilisation],
            "n_samples": self.n_samples,
        }
