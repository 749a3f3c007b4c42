r"""A body at the tool in one log that the others, or a model file, do not have: its mass and its position, log by log.

    tau = Y theta + [k = log] Y_end pi_k,     k = 1 .. K logs

`pi_k` are the ten inertial numbers of a rigid body fixed to the end link. The absolute load is not identifiable, so the logs
with the least load are the reference. Previously identified values, with standard errors, are a reference as well: they enter
as one more campaign on the motion of the training logs, with the forces computed from them. A model file keeps no covariance.
Its combinations are assumed to be known as well as these logs determine them, or worse in proportion to its standard errors.
Campaigns are compared with the causes found in the model (`evidence/campaigns.py`). An accepted load is added to the baseline
in its logs, and causes are searched again. Friction may follow the load, so a change of friction in the same log does not count
against it.
Reference: Khalil, Gautier & Lemoine 2007 (identification of the payload inertial parameters).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tau_dyn.diagnose.force_baseline import FittedBaseline, compute_load_columns, name_load
from tau_dyn.diagnose.nominal import MAX_MASS_SHARE
from tau_dyn.diagnose.payload import (
    MIN_AMPLITUDE_Z,
    PAYLOAD,
    BodyEstimate,
    build_load_parameters,
    constrain_loads,
    estimate_body,
    find_end_link,
    find_payload_frame,
    is_identified,
    list_load_names,
)
from tau_dyn.diagnose.preparation import compute_border_gap_s
from tau_dyn.effects import PARAMETER_CAUSES, Effect, format_quantity
from tau_dyn.estimate import Estimate, PhysicalConstraints, Regression, RegressionRun, solve_least_squares
from tau_dyn.evidence import (
    TEST,
    TRAIN,
    CampaignChange,
    CampaignChannel,
    Channel,
    Finding,
    Gain,
    OutputErrors,
    Step,
    build_extended_regression,
    compute_campaign_gain,
    confirm_campaign_change,
    divide_every_log,
    explain_misfit,
    select_campaign_changes,
    solve_with_fallback,
)
from tau_dyn.message_codes import CodedWarning
from tau_dyn.parameters import Parameter, Parameters
from tau_dyn.results import format_list
from tau_dyn.robot import LinkInertia, Robot

REFERENCE = "\0model file"
"""Name of the campaign that represents the values of a model file; no file has this name."""
_BODIES = "bodies"
_SMALL_BODY_CHANGE = 0.01
"""Statistic of a change of the bodies over that of a load below which the load alone is reported: a tenth of its force."""
_FRICTION = "friction"


@dataclass(frozen=True, eq=False)
class Load:
    """A body that some logs carry beyond the others.

    Attributes:
        logs: Names of the logs.
        values: Its ten inertial numbers in the end link's joint frame (10,).
        known: Whether the values are fixed, because a model file is the only reference.
        finding: The finding that reports it.
    """

    logs: tuple[str, ...]
    values: np.ndarray
    known: bool
    finding: Finding

    @property
    def is_confirmed(self) -> bool:
        """Whether the held-out blocks of its logs agree."""
        return self.finding.status == "confirmed"

    @property
    def is_body(self) -> bool:
        """Whether its mass is distinct from zero."""
        mass = self.finding.parameters[0]
        return mass.stderr is not None and mass.value > MIN_AMPLITUDE_Z * mass.stderr

    @property
    def parameters(self) -> Parameters:
        """The ten numbers as parameters of the baseline, free unless known."""
        return build_load_parameters(name_load(self.logs), self.values if self.known else None)


def find_loads(
    case: FittedBaseline, channel: Channel, effects: Sequence[Effect], rng: np.random.Generator
) -> list[Load]:
    """Return the bodies that logs carry at the tool, beyond the other logs or a model file.

    Args:
        case: The fitted baseline.
        channel: Its channel.
        effects: Causes found, which are included.
        rng: Random numbers for intervals.
    """
    body, logs = find_end_link(case.nominal.robot), list(dict.fromkeys(run.name for run in channel.runs))
    identified = is_identified(case.nominal.robot, case.nominal.parameters)
    if body is None or len(logs) + identified < 2:
        return []
    study = _Study.of(case, channel, effects, body, identified)
    changes = select_campaign_changes(
        study.channel,
        study.noise,
        study.kinds,
        logs,
        likelier=PAYLOAD,
        companions=[kind for kind in study.kinds if kind.startswith(_FRICTION)],
        reference=identified,
    )
    carried = [one for one in changes if one.kind == PAYLOAD]
    if not carried:
        return []
    study = study.account_for([one for one in changes if one.kind != PAYLOAD and not _is_small(one, carried)])
    groups = study.choose_reference([(one.log,) for one in carried], logs, identified)
    known = identified and {log for group in groups for log in group} == set(logs)
    found = [study.describe(group, groups, carried, logs, known, rng) for group in groups]
    return [one for one in found if one.is_body]


@dataclass(frozen=True, eq=False)
class _Study:
    """The campaigns of one case.

    Attributes:
        robot: The robot.
        body: Its end link.
        channel: Runs of all logs and of the reference, with the columns that they share.
        noise: Noise model of each output.
        kinds: Columns (n, m, k) of each run, by kind of change.
        physics: Physical consistency of the baseline's values.
    """

    robot: Robot
    body: LinkInertia
    channel: CampaignChannel
    noise: tuple
    kinds: dict[str, list[np.ndarray]]
    physics: PhysicalConstraints

    @classmethod
    def of(
        cls, case: FittedBaseline, channel: Channel, effects: Sequence[Effect], body: LinkInertia, identified: bool
    ) -> _Study:
        """Build the campaigns: the noise is that of a fit with separate changes of all kinds in every log."""
        robot = case.nominal.robot
        regression = build_extended_regression(channel, effects)
        gap_s = compute_border_gap_s(case.preparation.force_cutoff_hz, case.channel.prepared[0].log.rate_hz)
        campaigns = CampaignChannel(
            channel.name, channel.outputs, channel.units, regression.parameters, regression.runs,
            divide_every_log(channel, gap_s),
        )  # fmt: skip
        plain = solve_with_fallback(regression, case.physics)
        loads = [masked for masked, _ in compute_load_columns(case.nominal, case.channel.prepared)]
        kinds = _list_kinds(case, body, campaigns, plain, loads)
        own = solve_with_fallback(_give_every_log_its_own(campaigns, kinds), None)
        study = cls(robot, body, campaigns, own.noise, kinds, case.physics)
        return study._add_reference(case.nominal.parameters, own) if identified else study

    def _add_reference(self, trusted: Parameters, own: Estimate) -> _Study:
        """Return the study with the campaign of a model file: its bodies' forces on these motions, and noise of the same kind.

        Its noise is the residual of these logs in reverse, which has the same spectrum and is unrelated to the motion.
        """
        names = self.channel.parameters.names
        bodies = np.isin(names, self.robot.parameters.names)
        values = np.array([trusted[n].value if mine else 0.0 for n, mine in zip(names, bodies, strict=True)])
        logs = tuple(dict.fromkeys(run.name for run in self.channel.runs))
        fit = solve_with_fallback(self.regression([logs], TRAIN, TEST), None)
        pairs = [(trusted[n].stderr, fit.parameters[n].stderr) for n in self.robot.parameters.names]
        ratios = [a / b for a, b in pairs if a and b]
        share = 1 / max(1.0, float(np.sqrt(np.mean(np.square(ratios))))) if ratios else 1.0
        runs, parts = list(self.channel.runs), list(self.channel.parts)
        for run, e in zip(self.channel.runs, own.residuals(), strict=True):
            W = share * np.where(bodies, run.W, 0.0)
            y = W @ values + e[::-1]
            runs.append(RegressionRun(REFERENCE, run.t, W, y, run.usable, W, y))
            parts.append(np.full(len(run.t), TRAIN))
        channel = replace(self.channel, runs=tuple(runs), parts=tuple(parts))
        kinds = {kind: [*columns, *(np.zeros_like(c) for c in columns)] for kind, columns in self.kinds.items()}
        return replace(self, channel=channel, kinds=kinds)

    def account_for(self, changes: Sequence[CampaignChange]) -> _Study:
        """Return the study with changes of other kinds included."""
        channel = self.channel
        for one in changes:
            channel = channel.with_change(one, self.kinds[one.kind])
        return replace(self, channel=channel)

    def carry(self, groups: Sequence[Sequence[str]]) -> CampaignChannel:
        """Return the channel in which every group of logs carries its own body."""
        channel = self.channel
        for logs in groups:
            columns = channel.mask_columns(self.kinds[PAYLOAD], logs)
            channel = channel.with_columns(build_load_parameters(name_load(logs)), columns)
        return channel

    def regression(self, groups: Sequence[Sequence[str]], *parts: int) -> Regression:
        """Return the regression of some parts in which every group of logs carries its own body."""
        channel = self.carry(groups)
        runs = tuple(replace(r, usable=m) for r, m in zip(channel.runs, channel.masks(*parts), strict=True))
        return Regression(channel.parameters, channel.outputs, channel.units, runs)

    def solve(self, groups: Sequence[Sequence[str]], *parts: int) -> Estimate:
        """Return the joint estimate, with physically consistent links and loads."""
        physics = constrain_loads(self.physics, [name_load(group) for group in groups])
        return solve_with_fallback(self.regression(groups, *parts), physics)

    def choose_reference(
        self, groups: list[tuple[str, ...]], logs: Sequence[str], identified: bool
    ) -> list[tuple[str, ...]]:
        """Return the groups of logs that carry more than the lightest group, which becomes the reference."""
        if identified:
            return groups
        regression = self.regression(groups, TRAIN, TEST)
        free = {p.name: {"lower": -np.inf} for p in regression.parameters if p.name.startswith(f"{PAYLOAD}.")}
        estimate = solve_least_squares(regression.with_parameters(regression.parameters.update(free)))
        masses = [estimate.parameters[list_load_names(name_load(group))[0]].value for group in groups]
        if min(masses) >= 0:
            return groups
        lightest = groups[int(np.argmin(masses))]
        others = tuple(log for log in logs if all(log not in group for group in groups))
        return [*(group for group in groups if group is not lightest), *([others] if others else [])]

    def describe(
        self,
        group: tuple[str, ...],
        groups: Sequence[tuple[str, ...]],
        carried: Sequence[CampaignChange],
        logs: Sequence[str],
        known: bool,
        rng: np.random.Generator,
    ) -> Load:
        """Return the load of one group of logs, and whether the held-out blocks of its logs agree."""
        estimate, names = self.solve(groups, TRAIN, TEST), list_load_names(name_load(group))
        frame, R, p = find_payload_frame(self.robot, self.body)
        found = estimate_body(estimate, names, R, p)
        change = next((one for one in carried if one.log in group), carried[0])
        others = [g for g in groups if g != group]
        columns = self.channel.mask_columns(self.kinds[PAYLOAD], group)
        test = confirm_campaign_change(self.carry(others), self.noise, columns)
        before, after = (self.regression(g, TEST).residuals(self.solve(g, TRAIN).theta) for g in (others, groups))
        gain = compute_campaign_gain(self.channel, group, before, after, rng, test)
        why = self._doubt(found, change, gain, test.is_confirmed) or explain_misfit(self.channel, group, gain)
        unloaded = [log for log in logs if all(log not in g for g in groups)]
        finding = Finding(
            PAYLOAD,
            (self.body.link,),
            "suspected" if why else "confirmed",
            change.statistic,
            change.p_value,
            tuple(build_body_parameters(found, frame)),
            gain,
            (),
            f"{PARAMETER_CAUSES[PAYLOAD]}, in {format_list(list(group))}",
            format_load_sentence(found, frame, group, unloaded),
            "",
            confirmation=(test.share, test.stderr),
            why_not_confirmed=why,
            logs=group,
        )
        values = estimate.parameters.select(names).values
        return Load(group, values, known, finding)

    def _doubt(self, found: BodyEstimate, change: CampaignChange, gain: Gain, confirmed: bool) -> str:
        """Return the reason why a body is only suspected, in words; empty if it is confirmed."""
        mass = float(found.values[0])
        total = float(sum(link.nominal[0] for link in self.robot.links))
        away = float(np.linalg.norm(np.where(found.known[1:4], found.values[1:4], 0.0)))
        reach = _measure_reach(self.robot)
        if total > 0 and mass > MAX_MASS_SHARE * total:
            return f"its mass is more than {MAX_MASS_SHARE:g} times the robot's"
        if reach > 0 and away > reach:
            return f"its centre is {away:.3g} m from the tool, farther than the robot reaches"
        if not change.explains:
            return "more differs in this log than a body at the tool explains"
        if not confirmed:
            return "the held-out blocks of this log do not show it"
        if not gain.ci95[0] > 0:
            return f"its gain is not above zero (95 % interval {gain.ci95[0]:.2g} to {gain.ci95[1]:.2g} %)"
        return ""


def _is_small(change: CampaignChange, carried: Sequence[CampaignChange]) -> bool:
    """Return whether a change of the bodies is small next to a load of the same log, whose force free bodies would take up."""
    loads = [one.statistic for one in carried if one.log == change.log and one.explains]
    return change.kind == _BODIES and bool(loads) and change.statistic < _SMALL_BODY_CHANGE * max(loads)


def _list_kinds(
    case: FittedBaseline, body: LinkInertia, channel: CampaignChannel, plain: Estimate, loads: Sequence[np.ndarray]
) -> dict[str, list[np.ndarray]]:
    """Return the columns (n, m, k) of each run of every kind of change that may be in one log alone."""
    names, robot = channel.parameters.names, case.nominal.robot
    bodies = np.isin(names, robot.parameters.names)
    kinds = {PAYLOAD: [*loads]}
    for joint in robot.driven:
        mine = [k for k, n in enumerate(names) if n in case.nominal.effect_parameters and n.startswith(f"{joint}.")]
        if mine:
            kinds[f"{_FRICTION} of {joint}"] = [run.W[:, :, mine] for run in channel.runs]
    for link in robot.links:
        if link.link != body.link:
            mine = names.index(f"{link.link}.mass") if f"{link.link}.mass" in names else None
            if mine is not None:
                kinds[f"mass of {link.link}"] = [run.W[:, :, [mine]] for run in channel.runs]
    theta = np.where(bodies, plain.theta, 0.0)
    for k, joint in enumerate(() if robot.base_coordinates else robot.actuated):
        only = np.arange(robot.na) == k
        kinds[f"force of {joint}"] = [((run.W @ theta) * only)[:, :, None] for run in channel.runs]
    kinds[_BODIES] = [run.W[:, :, bodies] for run in channel.runs]
    return kinds


def _give_every_log_its_own(channel: CampaignChannel, kinds: dict[str, list[np.ndarray]]) -> Regression:
    """Return the regression in which every log has a change of every kind."""
    for log in dict.fromkeys(run.name for run in channel.runs):
        for kind, columns in kinds.items():
            channel = channel.with_change(CampaignChange(kind, log, 0.0, 0, 1.0), columns)
    return Regression(channel.parameters, channel.outputs, channel.units, channel.runs)


def _measure_reach(robot: Robot) -> float:
    """Return the length of the chain of joint placements [m], the farthest that a tool can be from the base."""
    model = robot.model
    steps = [float(np.linalg.norm(place.translation)) for place in model.jointPlacements]
    tool = (
        0.0 if robot.tool_frame is None else float(np.linalg.norm(model.frames[robot.tool_frame].placement.translation))
    )
    return sum(steps) + tool


def build_body_parameters(found: BodyEstimate, frame: str) -> list[Parameter]:
    """Return the mass, and the coordinates of the centre that the data determine."""
    stderr = float(found.stderr[0]) if found.known[0] else None
    rows = [Parameter("payload.mass", float(found.values[0]), "kg", stderr=stderr, origin=PAYLOAD)]
    for k, axis in enumerate("xyz", start=1):
        if found.known[k]:
            rows.append(
                Parameter(
                    f"payload.centre_{axis}", float(found.values[k]), "m", stderr=float(found.stderr[k]),
                    origin=f"in the frame of {frame}",
                )
            )  # fmt: skip
    return rows


def format_load_sentence(found: BodyEstimate, frame: str, group: Sequence[str], unloaded: Sequence[str]) -> str:
    """Return a sentence with the mass and position of a body that a group of logs carries, and the logs without it."""
    rows = [
        (axis, float(found.values[k]), float(found.stderr[k]))
        for k, axis in enumerate("xyz", start=1)
        if found.known[k]
    ]
    place = ", ".join(f"{axis} = {format_quantity(value, 'm', stderr)}" for axis, value, stderr in rows)
    mass = format_quantity(float(found.values[0]), "kg", float(found.stderr[0]))
    text = f"{format_list(list(group))} {'carries' if len(group) == 1 else 'carry'} {mass}"
    text += f" at {place} in the frame of {frame}" if place else ""
    others = format_list(list(unloaded)) if unloaded else "the model"
    return f"{text}; {others} {'do' if len(unloaded) > 1 else 'does'} not."


def list_load_warnings(loads: Sequence[Load]) -> list[str]:
    """Return a warning for each confirmed load."""
    return [CodedWarning("load_changed", one.finding.sentence.rstrip(".")) for one in loads if one.is_confirmed]


def add_loads(case: FittedBaseline, loads: Sequence[Load]) -> FittedBaseline:
    """Return the baseline in which logs carry the bodies that are confirmed."""
    loads = [one for one in loads if one.is_confirmed]
    physics = constrain_loads(case.physics, [name_load(one.logs) for one in loads if not one.known])
    carried = tuple((one.logs, one.parameters) for one in loads)
    return replace(case, loads=carried, physics=physics)


@dataclass(frozen=True, eq=False)
class LoadReport:
    """The part of a diagnosis that concerns loads.

    Attributes:
        findings: A finding for each load.
        without: Errors of the refit without loads; None if no load was accepted.
    """

    findings: tuple[Finding, ...] = ()
    without: OutputErrors | None = None

    @classmethod
    def of(cls, loads: Sequence[Load], without: OutputErrors | None) -> LoadReport:
        """Report loads; without an accepted one all are suspected."""
        findings = (
            one.finding if without and one.is_confirmed else replace(one.finding, status="suspected") for one in loads
        )
        return cls(tuple(findings), without)

    @property
    def confirmed(self) -> tuple[Finding, ...]:
        """The findings of the loads that the baseline carries."""
        return tuple(f for f in self.findings if f.status == "confirmed")

    def insert_step(self, steps: Sequence[Step]) -> tuple[Step, ...]:
        """Return a waterfall that starts with `nominal` and `refitted`, with the step of the loads after a refit without them."""
        if self.without is None:
            return tuple(steps)
        nominal, refitted, *causes = steps
        carried = Step(f"{PAYLOAD} {name_load(self.confirmed[0].logs)}", refitted.errors)
        return nominal, Step("refitted", self.without), carried, *causes
