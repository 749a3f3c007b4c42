"""Measured forces and a model -> where the simulation is wrong, which cause explains it, and the gain.

Beside what every channel goes through (`stages.py`): the baseline stays physical, its parameters are held against their nominal
values, and a cause has to be more than what encoder noise makes of itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.channel import Channel
from tau_dyn.diagnose.encoders import DRAWN, NoiseOnly, noise_only
from tau_dyn.diagnose.filters import border_gap, clear_cutoff, diagnosis_preparation, smooth_cutoffs, thinned_log
from tau_dyn.diagnose.fits import FAMILY_LEVEL
from tau_dyn.diagnose.force import ForceChannel, force_channel, force_regression, prepared_pieces
from tau_dyn.diagnose.limits import limits_of
from tau_dyn.diagnose.nominal import parameter_findings
from tau_dyn.diagnose.resonances import with_band, with_resonances
from tau_dyn.diagnose.result import Diagnosis, Finding, Unexplained, Untestable, Verdict
from tau_dyn.diagnose.search import Search, effects_of, search
from tau_dyn.diagnose.stages import (
    HELD_OUT,
    SHARED,
    Answer,
    assembled,
    confirmed,
    estimated,
    findings_of,
    supported,
)
from tau_dyn.diagnose.trials import DRAWS
from tau_dyn.diagnose.unexplained import unexplained_of
from tau_dyn.diagnose.unknown import Structure, find_structure, structure_chance
from tau_dyn.diagnose.waves import shows_waves
from tau_dyn.diagnose.within import heard, tests_of
from tau_dyn.diagnose.words import verdict_sentence
from tau_dyn.estimate import Physics, solve_least_squares
from tau_dyn.identify.logs import log_warnings
from tau_dyn.identify.preparation import Preparation
from tau_dyn.identify.regression import even_pieces
from tau_dyn.identify.structure import physics_of
from tau_dyn.log import Log
from tau_dyn.model import Model

Progress = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Case:
    """A baseline fitted to logs, ready to be doubted.

    Attributes:
        nominal: The baseline before the fit.
        model: The baseline at fitted values.
        channel: All data, with the baseline's columns.
        physics: What makes the baseline's values physical.
        preparation: Filters and masks.
        smooth_hz: Low-pass of each piece's positions [Hz].
        clear_hz: Low-pass of the forces that springs carry [Hz].
        held: Whether a piece belongs to a held-out log.
        pieces: Even stretches of the training logs, then of the held-out logs, as they were logged.
        how: How the data are divided, in words.
    """

    nominal: Model
    model: Model
    channel: Channel
    physics: Physics
    preparation: Preparation
    smooth_hz: tuple[float, ...]
    clear_hz: float
    held: tuple[bool, ...]
    pieces: tuple[Log, ...]
    how: str

    def noise_only(self, rng: np.random.Generator) -> Channel:
        """Return the channel of logs that hold nothing but the baseline and encoder noise."""
        assert isinstance(self.channel, ForceChannel)
        logs = noise_only(self.channel, self.model, self.pieces, self.smooth_hz, rng)
        prepared = prepared_pieces(self.nominal, logs, self.preparation, self.smooth_hz)
        regression = force_regression(self.nominal, prepared, self.preparation)
        return replace(
            force_channel(self.model, prepared, self.held, self.preparation, regression, self.clear_hz),
            parameters=self.nominal.parameters,
        )


def gather(
    model: Model,
    train_logs: list[Log],
    held_logs: list[Log],
    preparation: Preparation | None,
    exclude: tuple[str, ...],
    progress: Progress,
    warnings: list[str],
) -> Case:
    """Return the baseline fitted to the training logs, with all of the data.

    Args:
        model: The baseline at its nominal values.
        train_logs: Logs to train on.
        held_logs: Held-out logs.
        preparation: Filters and masks; None to choose them.
        exclude: Log columns whose nonzero samples are left out.
        progress: Called with a word for each step.
        warnings: What is doubtful is added here.

    Raises:
        CannotAnswer: The logs determine nothing, or are too short for three parts.
    """
    train, held = ([piece for log in logs for piece in even_pieces(log)] for logs in (train_logs, held_logs))
    warnings += [*model.robot.warnings, *log_warnings(model.robot, [*train, *held])]
    preparation = preparation or diagnosis_preparation(model.robot, train, exclude)
    pieces = (*train, *held)
    is_held = (*[False] * len(train), *[True] * len(held))
    how = (HELD_OUT if held else SHARED).format(what="logs")
    smooth_hz, clear_hz = smooth_cutoffs(model.robot, train, held), clear_cutoff(model.robot, train)
    case = _fitted(model, pieces, is_held, preparation, smooth_hz, clear_hz, how, progress)
    assert isinstance(case.channel, ForceChannel)
    if shows_waves(case.channel, smooth_hz):
        smooth_hz = (preparation.position_cutoff_hz,) * len(pieces)  # as they are
        case = _fitted(model, pieces, is_held, preparation, smooth_hz, clear_hz, how, progress)
    return case


def _fitted(
    model: Model,
    pieces: tuple[Log, ...],
    is_held: tuple[bool, ...],
    preparation: Preparation,
    smooth_hz: tuple[float, ...],
    clear_hz: float,
    how: str,
    progress: Progress,
) -> Case:
    """Return the baseline fitted to pieces whose positions are low-passed at `smooth_hz` [Hz], each at its own."""
    progress("columns")
    thinned = [thinned_log(piece, preparation.position_cutoff_hz) for piece in pieces]
    prepared = prepared_pieces(model, thinned, preparation, smooth_hz)
    regression = force_regression(model, prepared, preparation)
    physics = physics_of(model)
    progress("baseline")
    first = replace(regression, runs=regression.runs[: is_held.count(False)])
    estimate = solve_least_squares(first, physics=physics)
    fit = model.with_parameters(estimate.parameters)
    channel = force_channel(fit, prepared, is_held, preparation, regression, clear_hz)
    channel = replace(channel, parameters=model.parameters)
    return Case(model, fit, channel, physics, preparation, smooth_hz, clear_hz, is_held, pieces, how)


def diagnose_forces(case: Case, seed: int, progress: Progress, warnings: list[str]) -> Diagnosis:
    """Find causes of what the baseline leaves of the forces."""
    progress("looking for resonances")
    channel, rng = with_resonances(case.channel), np.random.default_rng(seed)
    assert isinstance(channel, ForceChannel)
    progress("looking for causes")
    noise = NoiseOnly(lambda: [case.noise_only(rng) for _ in range(DRAWN)])
    hunt = search(channel, rng, progress, sift=noise.sift)
    structure = find_structure(channel, hunt.ground, hunt.ground.draws(DRAWS, rng), FAMILY_LEVEL)
    hunt, structure = _sifted(noise, hunt, structure)
    progress("confirming")
    rate = channel.prepared[0].log.rate_hz
    gap = border_gap(case.preparation.force_cutoff_hz, rate)
    tests = heard(channel, hunt, tests_of(channel, hunt, structure), gap, rng, noise)
    kept = confirmed(channel, hunt, tests.causes, physics=case.physics)
    progress("measuring the gain")
    nominal = case.nominal.parameters
    kept, bars = supported(channel, hunt, tests.causes, kept, rng, nominal=nominal.values, physics=case.physics)
    before, after = bars.judgements[0], bars.judgements[-1]
    findings = [with_band(f, case.clear_hz) for f in findings_of(channel, hunt, tests.causes, kept, bars, rng)]
    findings += parameter_findings(case.nominal, nominal, estimated(after), after.estimate)
    unexplained = unexplained_of(channel, hunt, tests.structure)
    limits, untestable = limits_of(channel, hunt, [f.cause for f in findings])
    verdict = _verdict(findings, unexplained)
    answer = Answer(
        verdict,
        verdict_sentence(verdict, findings, unexplained, before.errors, after.errors),
        case.how,
        findings,
        unexplained,
        limits,
        _with_drift(untestable, unexplained),
        _experiment(verdict, findings),
        warnings,
        {"preparation": case.preparation.to_dict()},
    )
    return assembled(channel, hunt, kept, bars, case.nominal, answer, seed)


def _sifted(noise: NoiseOnly, hunt: Search, structure: Structure | None) -> tuple[Search, Structure | None]:
    """Leave out what encoder noise alone could have made, beside all that was found."""
    kept = []
    for one in hunt.found:
        left = noise.sift(hunt.ground, one.candidate, hunt.others(one), hunt.n_causes)
        if left is not None:
            kept.append(replace(one, candidate=left))
    if structure is not None and structure_chance(noise, hunt.ground, structure, effects_of(hunt.found)) > FAMILY_LEVEL:
        structure = None
    return replace(hunt, found=tuple(kept)), structure


def _with_drift(untestable: tuple[Untestable, ...], unexplained: tuple[Unexplained, ...]) -> tuple[Untestable, ...]:
    """Say that a residual that drifts in time may be warmth, where no temperature was logged."""
    drifts = [u.joint for u in unexplained if "t" in u.depends_on]
    if not drifts:
        return untestable
    why = f"the residual of {drifts[0]} drifts in time, and the logs give no temperature"
    return tuple(
        replace(u, why=why, experiment="log temp_JOINT or temp_room [degC] and repeat the motion from cold to warm")
        if u.cause == "thermal_drift"
        else u
        for u in untestable
    )


def _verdict(findings: Sequence[Finding], unexplained: tuple[Unexplained, ...]) -> Verdict:
    if any(f.status == "confirmed" for f in findings):
        return "named"
    parameters = [f for f in findings if f.status == "parameter"]
    if parameters:
        return "cannot_tell" if any("drive_gain" in f.indistinguishable_from for f in parameters) else "named"
    return "unexplained" if any(u.status == "confirmed" for u in unexplained) else "nothing_found"


def _experiment(verdict: Verdict, findings: Sequence[Finding]) -> str:
    return next((f.experiment for f in findings if f.experiment), "") if verdict == "cannot_tell" else ""
