r"""The innovation form seen as an output-error model: its one-step predictor has inputs (u, y).

    x+ = (A - K C) x + [B - K D, K] (u, y),    yhat = C x + [D, 0] (u, y).

Reference: Ljung 1999, (4.91)-(4.95).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tau_dyn.modes.modal_form import ModalForm
from tau_dyn.modes.record import Record
from tau_dyn.modes.state_space import StateSpace


def build_predictor(model: StateSpace) -> StateSpace:
    """Return the one-step predictor as a model from (u, y) to the predicted y."""
    B = np.hstack([model.B - model.K @ model.D, model.K])
    D = np.hstack([model.D, np.zeros((len(model.C), len(model.C)))])
    return replace(model, A=model.A - model.K @ model.C, B=B, D=D, K=np.zeros_like(model.K))


def build_innovation_model(form: ModalForm) -> StateSpace:
    """Return the innovation form whose predictor has this modal form."""
    predictor = form.state_space()
    m = form.D.shape[1] - form.D.shape[0]
    K, D = predictor.B[:, m:], predictor.D[:, :m]
    return replace(predictor, A=predictor.A + K @ predictor.C, B=predictor.B[:, :m] + K @ D, D=D, K=K)


def build_predictor_record(record: Record) -> Record:
    """Return a record whose inputs are (u, y)."""
    return replace(record, u=np.hstack([record.u, record.y]), inputs=record.inputs + record.outputs)
