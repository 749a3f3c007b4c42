"""What a diagnosis leaves open, and whether a motion can answer it.

In this order: the strongest cause with twins; several causes that are only suspected; one that is; a payload, a gain or another
number that no motion can settle; else all causes that were not found, or that the motion did not show.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import permutations

from tau_dyn.diagnose.result import Diagnosis, Finding
from tau_dyn.effects import EFFECTS, Effect
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.parameters import Parameters

_MAX_HYPOTHESES = 3
"""Suspected causes that are told from each other."""

_WEIGHING = (
    "weigh one moving part or a payload and fix its mass (--fix NAME.mass=...); forces cannot give the drives' gain"
)
_OTHER_EXPERIMENTS = {
    "torque_offset": "read the drive's force at rest with the joint uncoupled, without gear and seals, for an offset alone",
    "coulomb_asymmetry": "read the drive's force at rest with the joint uncoupled, without gear and seals, for an offset alone",
    "drive_gain": _WEIGHING,
    "payload": _WEIGHING,
    "link_mass": _WEIGHING,
    "resolver_error": "put a sensor on the load side (a linear scale, a laser) and compare it with the encoder",
    "transmission_error": "put a sensor on the load side (a linear scale, a laser) and compare it with the encoder",
    "clock_offset": "record one event, such as a tap, through both the force and the position channel",
    "guideway_not_straight": "measure the cart's orientation along the guideway",
}


@dataclass(frozen=True, eq=False)
class CauseHypothesis:
    """A cause with its effects and the amplitudes that it would have."""

    cause: str
    effects: tuple[Effect, ...]
    values: Parameters

    @classmethod
    def of(cls, finding: Finding) -> CauseHypothesis:
        """Take what was found."""
        return cls(finding.cause, finding.effects, Parameters(finding.parameters))

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that it acts on."""
        return tuple(dict.fromkeys(j for e in self.effects for j in e.joints))


@dataclass(frozen=True, eq=False)
class DesignGoal:
    """What a motion is to answer.

    Attributes:
        pairs: A suspect, and the name of the rival it is to be told from; an empty name is none of them, but chance.
        others: Effects that are sure and refitted anyway.
        beyond: Twins that no motion tells from the suspect, and the experiment that would.
        causes: Without pairs, the causes to be seen sooner.
    """

    pairs: tuple[tuple[CauseHypothesis, str], ...] = ()
    others: tuple[Effect, ...] = ()
    beyond: tuple[tuple[str, str], ...] = ()
    causes: tuple[type[Effect], ...] = ()


def find_design_goal(diagnosis: Diagnosis, signals: Collection[str]) -> DesignGoal:
    """Return what is open.

    Args:
        diagnosis: The diagnosis.
        signals: What a motion alone gives effects to feel; a cause that feels more is beyond it.

    Raises:
        CannotAnswer: Something is open that no motion of the robot answers.
    """
    if diagnosis.channel != "force":
        raise CannotAnswer(
            "unsupported",
            f"motions are proposed for measured forces only, and this diagnosis is of {diagnosis.channel} measurements",
            diagnosis.experiment or _first(diagnosis) or "measure more places, at uneven steps, from both directions",
        )
    found = [f for f in diagnosis.findings if f.effects and f.channel == "force"]
    for finding in found:
        if finding.indistinguishable_from:
            return _twins(diagnosis, finding, signals)
    suspected = [f for f in found if f.status == "suspected"][:_MAX_HYPOTHESES]
    if suspected:
        sure = _sure(diagnosis, suspected)
        if len(suspected) == 1:
            return DesignGoal(((CauseHypothesis.of(suspected[0]), ""),), sure)
        return DesignGoal(tuple((CauseHypothesis.of(a), b.cause) for a, b in permutations(suspected, 2)), sure)
    for finding in diagnosis.findings:
        if finding.status == "parameter" and finding.indistinguishable_from:
            raise _beyond(finding.cause, finding.indistinguishable_from, finding.experiment)
    return _unseen(diagnosis, signals)


def find_other_experiment(cause: str, twin: str, default: str = "") -> str:
    """Return the experiment other than a motion that tells two causes apart."""
    known = _OTHER_EXPERIMENTS.get(twin) or _OTHER_EXPERIMENTS.get(cause) or default
    if known:
        return known
    first = next((EFFECTS[name] for name in (twin, cause) if name in EFFECTS), None)
    return first.reveals if first else f"measure {twin.replace('_', ' ')} by itself"


def build_refusal(cause: str, twins: Sequence[tuple[str, str]]) -> CannotAnswer:
    """Return the refusal where no motion tells a cause from its twins, pairs of name and experiment."""
    names = " or ".join(name for name, _ in twins)
    experiments = list(dict.fromkeys(experiment for _, experiment in twins))
    return CannotAnswer("no_solution", f"no motion of this robot tells {cause} from {names}", "; ".join(experiments))


def _beyond(cause: str, twins: Sequence[str], default: str = "") -> CannotAnswer:
    return build_refusal(cause, [(twin, find_other_experiment(cause, twin, default)) for twin in twins])


def _twins(diagnosis: Diagnosis, finding: Finding, signals: Collection[str]) -> DesignGoal:
    """Return the question between a finding and those of its twins that a motion can make, or refuse."""
    twins = finding.indistinguishable_from
    out = [t for t in twins if not _of_motion(t, signals) or t in finding.effects[0].equivalent]
    if not set(finding.effects[0].needs) <= set(signals):
        out = list(twins)
    left = [t for t in twins if t not in out]
    if not left:
        raise _beyond(finding.cause, twins)
    beyond = tuple((twin, find_other_experiment(finding.cause, twin)) for twin in out)
    return DesignGoal(tuple((CauseHypothesis.of(finding), t) for t in left), _sure(diagnosis, [finding]), beyond)


def _of_motion(cause: str, signals: Collection[str]) -> bool:
    return cause in EFFECTS and set(EFFECTS[cause].needs) <= set(signals)


def _unseen(diagnosis: Diagnosis, signals: Collection[str]) -> DesignGoal:
    names = [x.cause for x in (*diagnosis.untestable, *diagnosis.limits)]
    causes = tuple(EFFECTS[name] for name in dict.fromkeys(names) if _of_motion(name, signals))
    if not causes:
        raise CannotAnswer(
            "nothing_to_do",
            "nothing is left open that a motion would show",
            "; ".join(dict.fromkeys(u.experiment for u in diagnosis.untestable))
            or "record the motion that matters to you",
        )
    return DesignGoal(others=_sure(diagnosis, ()), causes=causes)


def _sure(diagnosis: Diagnosis, questioned: Sequence[Finding]) -> tuple[Effect, ...]:
    sure = [f for f in diagnosis.findings if f.status == "confirmed" and f.channel == "force"]
    return tuple(e for f in sure if f not in questioned for e in f.effects)


def _first(diagnosis: Diagnosis) -> str:
    return next((f.experiment for f in diagnosis.findings if f.experiment), "")
