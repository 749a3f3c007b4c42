"""Open questions of a diagnosis, whether a motion can answer them, and the quantities compared along candidate motions.

The question, in this order: the strongest cause with indistinguishable alternatives; several suspected causes; one suspected
cause; a payload, a gain or another number that no motion can determine; otherwise all causes that were not found, or that the
motion did not excite.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from tau_dyn.diagnose.proposal.design import (
    AlternativeCause,
    DesignMotion,
    SchurComplement,
    Setting,
    Thing,
    compute_columns,
    compute_gram_matrix,
    compute_imitating_amplitudes,
)
from tau_dyn.effects import EFFECTS, NO_EXPERIMENT, Effect, Motion, Scene
from tau_dyn.evidence import (
    MIN_UNABSORBED_SHARE,
    Diagnosis,
    Finding,
    build_scene,
)
from tau_dyn.exceptions import CannotAnswer
from tau_dyn.parameters import Parameters

_MAX_HYPOTHESES = 3
"""Largest number of suspected causes to be distinguished from each other."""

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
        """Initialise from a finding."""
        return cls(finding.cause, finding.effects, Parameters(finding.parameters))

    @property
    def joints(self) -> tuple[str, ...]:
        """The joints that it acts on."""
        return tuple(dict.fromkeys(j for e in self.effects for j in e.joints))


@dataclass(frozen=True, eq=False)
class DesignGoal:
    """The question that a motion has to answer.

    Attributes:
        pairs: A suspected cause, and the name of the alternative to distinguish it from; an empty name means chance.
        others: Confirmed effects, which are refitted.
        beyond: Alternatives that no motion distinguishes from the suspected cause, and the experiment that would.
        causes: Causes whose detection is to be improved, if there are no pairs.
    """

    pairs: tuple[tuple[CauseHypothesis, str], ...] = ()
    others: tuple[Effect, ...] = ()
    beyond: tuple[tuple[str, str], ...] = ()
    causes: tuple[type[Effect], ...] = ()


def find_design_goal(diagnosis: Diagnosis, signals: Collection[str]) -> DesignGoal:
    """Return the open question.

    Args:
        diagnosis: The diagnosis.
        signals: Signals that a motion alone provides to effects; a cause that needs other signals cannot be tested by it.

    Raises:
        CannotAnswer: The open question cannot be answered by a motion of the robot.
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
    """Return the experiment other than a motion that distinguishes two causes."""
    known = _OTHER_EXPERIMENTS.get(twin) or _OTHER_EXPERIMENTS.get(cause) or default
    if known:
        return known
    first = next((EFFECTS[name] for name in (twin, cause) if name in EFFECTS), None)
    return first.reveals if first else f"measure {twin.replace('_', ' ')} by itself"


def build_refusal(cause: str, twins: Sequence[tuple[str, str]]) -> CannotAnswer:
    """Return the error for a cause that no motion distinguishes from its alternatives, pairs of name and experiment."""
    names = " or ".join(name for name, _ in twins)
    experiments = list(dict.fromkeys(experiment for _, experiment in twins))
    return CannotAnswer(
        "no_solution", f"no motion of this robot separates {cause} from {names}", "; ".join(experiments)
    )


def _beyond(cause: str, twins: Sequence[str], default: str = "") -> CannotAnswer:
    return build_refusal(cause, [(twin, find_other_experiment(cause, twin, default)) for twin in twins])


def _twins(diagnosis: Diagnosis, finding: Finding, signals: Collection[str]) -> DesignGoal:
    """Return the question between a finding and its alternatives that a motion can excite, or raise."""
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
            "no open question is left that a motion would answer",
            "; ".join(dict.fromkeys(u.experiment for u in diagnosis.untestable if u.experiment != NO_EXPERIMENT))
            or "record the motion that matters to you",
        )
    return DesignGoal(others=_sure(diagnosis, ()), causes=causes)


def _sure(diagnosis: Diagnosis, questioned: Sequence[Finding]) -> tuple[Effect, ...]:
    sure = [f for f in diagnosis.findings if f.status == "confirmed" and f.channel == "force"]
    return tuple(e for f in sure if f not in questioned for e in f.effects)


def _first(diagnosis: Diagnosis) -> str:
    return next((f.experiment for f in diagnosis.findings if f.experiment), "")


_MAX_SETTINGS = 60  # settings of an alternative cause that are tried; bounds computing time
_MAX_SETTING_DISTANCE = 0.3
"""Settings of a fine grid this near the true cause's own are tried for an alternative."""
_WEAK = 1e-12  # smallest norm that a column is divided by
_IMITATED = 0.5  # share of a column's power that an alternative leaves, below which it imitates the cause


@dataclass(frozen=True, eq=False)
class Contrast:
    """One line of the question: the power of columns that all other columns and the alternative, if any, do not explain.

    Attributes:
        cause: The cause taken as true.
        rival: The alternative to distinguish it from; empty for chance.
        columns: Indices of its columns: the force of a suspected cause, or an effect's columns per unit.
        instead: The alternative's columns, or None.
    """

    cause: str
    rival: str
    columns: np.ndarray
    instead: AlternativeCause | None

    def strength(self, schur: SchurComplement) -> float:
        """Return lambda, or, for a cause per unit, the unexplained mean square of its columns."""
        if self.instead is not None:
            return self.instead.best(schur, int(self.columns[0]))[0]
        return float(np.mean(np.diag(schur.G)[self.columns]))


@dataclass(frozen=True, eq=False)
class DiscriminationDesign:
    """All columns and all lines of a plan.

    Attributes:
        setting: The diagnosis behind it.
        question: The open question.
        scene: Excitation of measured and candidate motions together.
        things: The effects that are judged, column after column.
        lines: The lines of the question.
    """

    setting: Setting
    question: DesignGoal
    scene: Scene
    things: tuple[Thing, ...] = ()
    lines: tuple[Contrast, ...] = ()

    @property
    def n_refitted(self) -> int:
        """Number of refitted columns."""
        others = sum(len(effect.parameters) for effect in self.question.others)
        return int(np.sum(self.setting.model.parameters.free)) + others

    def gram(self, motions: Sequence[DesignMotion]) -> np.ndarray:
        """Return the Gram matrix of white rows of all columns along motions."""
        setting, total = self.setting, np.zeros(())
        for motion, counts in motions:
            W = compute_columns(setting, motion, self.question.others, self.things)
            total = total + compute_gram_matrix(setting, motion, counts, W)
        return total

    def schur(self, total: np.ndarray) -> SchurComplement:
        """Return the Gram matrix of the residuals of columns on the refitted ones, with prior knowledge."""
        free = [q for q in self.setting.model.parameters if q.free]
        known = np.array([1 / q.prior_stderr**2 if q.prior_stderr else 0.0 for q in free])
        total = total.copy()
        index = np.arange(len(free))
        total[index, index] += known
        return SchurComplement.of(total, self.n_refitted)

    def strengths(self, total: np.ndarray) -> np.ndarray:
        """Return each line's strength along a motion whose rows have this Gram matrix."""
        schur = self.schur(total)
        return np.array([line.strength(schur) for line in self.lines])

    def merit(self, total: np.ndarray, most: np.ndarray) -> float:
        """Return the smallest strength; for causes to be detected, relative to the largest that can be expected."""
        found = self.strengths(total)
        return float(np.min(found if self.question.pairs else found / most))

    def most(self, grams: np.ndarray) -> np.ndarray:
        """Return the largest strength of each line among single pieces."""
        return np.maximum(np.max([self.strengths(one) for one in grams], axis=0), 1e-300)

    def showing(self, total: np.ndarray) -> DiscriminationDesign:
        """Return the plan with the lines that all candidates together excite."""
        schur = self.schur(total)
        kept = [
            ln
            for ln in self.lines
            if ln.strength(schur) > MIN_UNABSORBED_SHARE * max(float(np.mean(schur.raw[ln.columns])), _WEAK)
        ]
        return replace(self, lines=tuple(kept))


def get_required_signals(question: DesignGoal) -> frozenset[str]:
    """Return the computed signals that the question's effects need."""
    pairs = [
        cls for suspect, rival in question.pairs for cls in (*suspect.effects, *([EFFECTS[rival]] if rival else []))
    ]
    return frozenset(name for cls in (*pairs, *question.others, *question.causes) for name in cls.needs) - {"reversal"}


def build_design_scene(setting: Setting, motions: Sequence[Motion], signals: frozenset[str]) -> Scene:
    """Return the properties of all motions together."""
    robot = setting.model.robot
    return build_scene(
        motions,
        robot.actuated,
        robot.force_units,
        slow=setting.threshold,
        cutoff_hz=setting.highest_hz,
        duration=sum(len(motion.q) for motion in motions) / setting.rate_hz,
        signals=signals,
    )


def build_discrimination_plan(setting: Setting, question: DesignGoal, scene: Scene) -> DiscriminationDesign:
    """Return the plan that distinguishes suspected causes from their alternatives."""
    plan = DiscriminationDesign(setting, question, scene)
    for suspect, rival in question.pairs:
        plan = _with_pair(plan, suspect, rival, None)
    return plan


def add_mirrored_contrasts(plan: DiscriminationDesign, recorded: Sequence[DesignMotion]) -> DiscriminationDesign:
    """Return the plan with alternatives taken as true as well, at the amplitudes at which they imitate the suspected cause.

    An alternative that imitates less than half of it on the measured motion cannot be the cause of the measured effect.
    """
    if not plan.question.pairs:
        return plan
    schur = plan.schur(plan.gram(recorded))
    for line, (suspect, rival) in zip(plan.lines, plan.question.pairs, strict=True):
        if line.instead is None or any(s.cause == rival for s, _ in plan.question.pairs):
            continue
        x = int(line.columns[0])
        left, chosen = line.instead.best(schur, x)
        if chosen and left < _IMITATED * schur.G[x, x]:
            values = compute_imitating_amplitudes(schur, x, chosen)
            plan = _with_pair(plan, CauseHypothesis(rival, tuple(e for e, _ in chosen), values), suspect.cause, suspect)
    return plan


def build_detection_plan(setting: Setting, question: DesignGoal, scene: Scene) -> DiscriminationDesign:
    """Return the plan that excites causes, each on each group of joints at the setting in the middle of its grid."""
    plan = DiscriminationDesign(setting, question, scene)
    for cls in question.causes:
        groups = cls.groups(scene)
        alone = [g for g in groups if len(g) == 1]
        for joints in alone or groups:
            grid = cls.grid(scene, joints)
            if grid and cls.untestable(scene) is None:
                effect = _built(cls, scene, joints, grid[len(grid) // 2])
                plan, columns = _added(plan, (effect,))
                plan = replace(plan, lines=(*plan.lines, Contrast(cls.name, "", columns, None)))
    return plan


def _added(
    plan: DiscriminationDesign, effects: tuple[Effect, ...], values: Parameters | None = None
) -> tuple[DiscriminationDesign, np.ndarray]:
    """Return the plan with effects, per unit or at values, and the indices of their columns after the refitted ones."""
    sizes = [1 if v is not None else sum(len(e.parameters) for e in es) for es, v in (*plan.things, (effects, values))]
    return replace(plan, things=(*plan.things, (effects, values))), np.arange(sum(sizes[:-1]), sum(sizes))


def _with_pair(
    plan: DiscriminationDesign, suspect: CauseHypothesis, rival: str, found: CauseHypothesis | None
) -> DiscriminationDesign:
    """Return the plan with one more pair; if the alternative itself was `found`, its own settings are tried, too."""
    plan, x = _added(plan, suspect.effects, suspect.values)
    if not rival:
        return replace(plan, lines=(*plan.lines, Contrast(suspect.cause, "", x, None)))
    groups, columns = [], []
    for options in _options(EFFECTS[rival], plan.scene, suspect, found):
        places = []
        for effect in options:
            plan, where = _added(plan, (effect,))
            places.append(where)
        groups.append(options)
        columns.append(tuple(places))
    line = Contrast(suspect.cause, rival, x, AlternativeCause(tuple(groups), tuple(columns)))
    return replace(plan, lines=(*plan.lines, line))


def _options(
    cls: type[Effect], scene: Scene, suspect: CauseHypothesis, found: CauseHypothesis | None
) -> list[tuple[Effect, ...]]:
    """Return an alternative's effects for each group that shares joints with a suspected cause, one for each setting."""
    made = []
    for joints in cls.groups(scene):
        if not set(joints) & set(suspect.joints):
            continue
        grid = cls.grid(scene, joints)
        own = {k: x for e in suspect.effects for k, x in e.settings.items() if k in cls.defaults}
        if len(grid) > _MAX_SETTINGS:
            grid = _fewer(grid, own)
            grid.append(own | {k: x for k, x in grid[0].items() if k not in own})
        grid += [dict(e.settings) for e in (found.effects if found else ()) if e.joints == joints]
        if grid:
            made.append(tuple(_built(cls, scene, joints, settings) for settings in grid))
    return made


def _fewer(grid: list[dict[str, float]], own: dict[str, float]) -> list[dict[str, float]]:
    """Return at most `_MAX_SETTINGS` of a grid: those near the true cause's own settings if it has the same kind of settings."""
    near = [
        g
        for g in grid
        if own and all(abs(g[k] / x - 1) < _MAX_SETTING_DISTANCE for k, x in own.items() if x and k in g)
    ]
    near = near or grid
    return near[:: -(-len(near) // _MAX_SETTINGS)]


def _built(cls: type[Effect], scene: Scene, joints: tuple[str, ...], settings: dict[str, float]) -> Effect:
    return cls(joints, [scene.units[scene.index(j)] for j in joints], label="", **settings)
