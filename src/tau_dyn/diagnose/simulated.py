"""The closed loop simulated by the model before and after a diagnosis: a log driven again by its own references."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from tau_dyn.diagnose.result import Diagnosis
from tau_dyn.exceptions import InputError
from tau_dyn.log import Log
from tau_dyn.simulate import CascadeLaw, Replay, replay


def log_with_references(logs: Sequence[Log], joints: Sequence[str]) -> Log:
    """Return the first log that says what its controller was asked for.

    Raises:
        InputError: None does.
    """
    for log in logs:
        if log.has("q_ref", joints):
            return log
    raise InputError(
        "missing_column",
        f"none of {', '.join(log.name for log in logs)} has q_ref columns for {', '.join(joints)}; without references no closed "
        "loop can be simulated, so leave the controller out or add them",
    )


def add_simulation(
    diagnosis: Diagnosis, logs: Sequence[Log], law: CascadeLaw, progress: Callable[[str], None] = lambda step: None
) -> Diagnosis:
    """Return a diagnosis with `simulation`: how far the closed loop is from a log before and after the extension.

    Args:
        diagnosis: Gives both models.
        logs: Training logs; the first with `q_ref_J` is driven again.
        law: The rig's own controller.
        progress: Called with a word for each step.

    Raises:
        InputError: No log has references, or the simulated loop is unstable.
    """
    log = log_with_references(logs, diagnosis.model.robot.actuated)
    models = {"before": diagnosis.model, "after": diagnosis.extended_model}
    done: dict[str, Replay] = {}
    for when, model in models.items():
        if when == "after" and len(model.effects) == len(diagnosis.model.effects):
            done[when] = done["before"]  # nothing was added
            continue
        done[when] = replay(model, log, law, progress=lambda share: progress(f"simulating {100 * share:.0f} %"))
    doubts = tuple(dict.fromkeys([*diagnosis.warnings, *(w for run in done.values() for w in run.warnings)]))
    simulation = {"log": log.name, **{when: run.to_dict() for when, run in done.items()}}
    return replace(diagnosis, simulation=simulation, warnings=doubts)
