"""A workspace: size, cross-sections, the point cloud with the robot, maps, reasons for exclusion.

Cross-sections are figures of reachable points, of the reasons that exclude other points, and of maps with their scales.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tau_dyn import results as r
from tau_dyn.kinematics.workspace import ELASTIC_MAPS, KINDS, QUANTITIES, Section, Study, build_points_table
from tau_dyn.render.presentation import present_kind, warn

TALLEST = 420
"""Largest height of a section's plot [px]."""
LEVELS = 16
"""Number of colours of a map."""
SHOWN_UNITS = {
    "N/m": (1e-6, "N/µm"),
    "m/s": (1.0, "m/s"),
    "m": (1e6, "µm"),
    "Hz": (1.0, "Hz"),
    "N": (1.0, "N"),
    "1": (1.0, ""),
}
"""Factor and unit in which quantities are shown; files use SI units."""
_AXES = "xyz"
_MIN_LOG_RATIO = 12.0  # ratio of largest to smallest value above which a map is logarithmic


def get_reason_ink(kind: str) -> str:
    """Return the ink of a reason."""
    return "w-" + kind.replace(" ", "-")


def choose_window(found: Study, s: Section) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the drawn part of a section: the workspace with a margin of a fifth, within the box, and the carts."""
    marks = _find_marks(found)[:, [s.across, s.up]]
    limits = []
    for k, (x, used) in enumerate(((s.u, s.inside.any(axis=1)), (s.v, s.inside.any(axis=0)))):
        there = x[used] if used.any() else x
        air = 0.2 * max(float(np.ptp(there)), 1e-3)
        low, high = max(float(there.min()) - air, float(x[0])), min(float(there.max()) + air, float(x[-1]))
        thin = 0.03 * (high - low)
        limits.append((min(low, float(marks[:, k].min()) - thin), max(high, float(marks[:, k].max()) + thin)))
    return limits[0], limits[1]


def _build_figure(found: Study, s: Section, marks: list[r.Mark], style: str = "") -> r.Figure:
    """Return marks on a section, both axes at the same scale, with the carts and the tool at home."""
    xlim, ylim = choose_window(found, s)
    wide = r.THIRD - 56
    tall = wide * (ylim[1] - ylim[0]) / (xlim[1] - xlim[0])
    if tall > TALLEST:  # keep the scale of both axes equal: widen
        air = (tall / TALLEST - 1) * (xlim[1] - xlim[0]) / 2
        xlim, tall = (xlim[0] - air, xlim[1] + air), TALLEST
    spots = _find_marks(found)[:, [s.across, s.up]]
    at_home = (
        r.Dots(spots[:-1, 0], spots[:-1, 1], "w-cart", "square", 3.5),
        r.Dots(spots[-1:, 0], spots[-1:, 1], "w-home", "plus", 4.0),
    )
    x, y = r.Axis(f"{_AXES[s.across]} [m]", xlim), r.Axis(f"{_AXES[s.up]} [m]", ylim)
    return r.Figure(x, y, (*marks, *at_home), r.replace_minus_signs(s.name), (r.THIRD, round(tall) + 54), style=style)


def build_section_figure(found: Study, s: Section) -> r.Figure:
    """Return a section: the workspace, the reasons that exclude other points, the rods' joints on their guideways as squares."""
    kinds = [kind for kind in KINDS if kind != "out of reach"]
    of = np.full(s.code.shape, -1)
    for code, kind, _ in found.workspace.reasons.items():
        if kind in kinds:
            of[s.code == code] = kinds.index(kind)
    of[s.inside] = len(kinds)
    cells = r.Cells(s.u, s.v, of, (*map(get_reason_ink, kinds), "w-in"))
    return _build_figure(found, s, [cells])


def list_reasons(found: Study) -> list[str]:
    """Return the reasons that occur in any section, in their order."""
    codes = np.unique(np.concatenate([s.code.ravel() for s in found.sections])) if found.sections else []
    there = {kind for code, kind, _ in found.workspace.reasons.items() if code in codes}
    return [kind for kind in KINDS if kind in there and kind != "out of reach"]


def choose_map_scale(found: Study, name: str) -> tuple[float, float, bool]:
    """Return the limits of a map's colours over all sections, and whether the scale is logarithmic."""
    values = np.concatenate([s.maps[name][np.isfinite(s.maps[name])] for s in found.sections])
    if not len(values):
        return 0.0, 1.0, False
    low, high = (float(v) for v in np.quantile(values, [0.01, 0.99]))
    logarithmic = low > 0 and high > _MIN_LOG_RATIO * low
    return low, high if high > low else low + max(abs(low), 1e-9) * 1e-3, logarithmic


def build_map_figure(found: Study, s: Section, name: str) -> r.Figure:
    """Return a map of one quantity in a section."""
    low, high, logarithmic = choose_map_scale(found, name)
    values = s.maps[name]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.log(values / low) / np.log(high / low)) if logarithmic else (values - low) / (high - low)
    level = np.clip(np.floor(np.nan_to_num(share, nan=-1.0, posinf=1.0) * LEVELS), 0, LEVELS - 1).astype(int)
    cells = r.Cells(s.u, s.v, np.where(np.isnan(values), -1, level), [f"m{k}" for k in range(LEVELS)])
    return _build_figure(found, s, [cells], "over-map")


def build_scale(found: Study, name: str) -> r.ColourScale:
    """Return a map's scale: its colours from low to high with numbers."""
    low, high, logarithmic = choose_map_scale(found, name)
    factor, _ = SHOWN_UNITS[QUANTITIES[name].unit]
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    values = [low * (high / low) ** x if logarithmic else low + x * (high - low) for x in shares]
    return r.ColourScale([f"m{k}" for k in range(LEVELS)], [r.format_number(factor * x, 3) for x in values])


def _find_marks(found: Study) -> np.ndarray:
    """Return the positions at home of the rods' joints on their carts (or of an arm's actuators), then of the tool (n + 1, 3)."""
    machine = found.workspace.machine
    tool = machine.home.position
    if machine.rods is None:
        return np.concatenate([np.zeros((1, 3)), tool])
    return np.concatenate([machine.rods.base_points(machine.robot.home[None])[0], tool])


_MAX_SECTIONS = 4
"""Largest number of sections in a notebook."""
MAP_WORDS = {
    "condition": "How much better the best direction is than the worst; 1 is isotropic, large is near a singularity.",
    "manipulability": "Product of the Jacobian's singular values: how much the tool moves for a move of the actuators.",
    "singularity": "Least singular value of the homogenised closure: how far it is from a matrix that is singular; 0 is there.",
    "stiffness": "Force per displacement along the direction that gives way most, the tool free to turn.",
    "stiffness_x": "Force along x per displacement along x, the tool free to move otherwise.",
    "stiffness_y": "Force along y per displacement along y, the tool free to move otherwise.",
    "stiffness_z": "Force along z per displacement along z, the tool free to move otherwise.",
    "sag": "How far the springs let the tool move under the robot's own weight.",
    "sag_load": "How far the stated load moves the tool beyond that.",
    "resonance": "Lowest natural frequency on the springs, the drives held.",
    "resonance_2": "Second natural frequency on the springs, the drives held.",
    "speed": "Speed that the actuators' limits allow in every direction, without turning.",
    "force": "Force that the actuators' limits hold in every direction; gravity not counted.",
}
SIZE_UNITS = {"m3": "m³", "m2": "m²", "m": "m", "1": "points"}
"""Displayed unit of a size, by the workspace's dimension."""


@present_kind.register
def present_workspace(found: Study) -> r.Presentation:
    """Return the presentation of a workspace."""
    robot = found.workspace.machine.robot
    sections = [
        *warn([r.end_sentence(r.capitalise(text)) for text in (*robot.warnings, *found.warnings)]),
        r.Chapter("glance", "", lambda: [r.Facts(_list_facts(found), "three")]),
        r.Chapter("space", "In space", lambda: _build_space(found), when=found.workspace.dimension == 3),
        r.Chapter("sections", "Cross-sections", lambda: _build_sections(found), r.On.DRAWN, when=bool(found.sections)),
        r.Chapter("reasons", "Why not elsewhere", lambda: [_build_reasons(found)], r.On.ALL),
        r.Chapter("catalogue", "As in a catalogue", lambda: _build_catalogue(found), r.On.PRINTED),
        r.Chapter("maps", "Maps", lambda: _build_maps(found), when=bool(found.sections and found.maps)),
    ]
    return r.Presentation(
        "Workspace of", robot.name, f"{robot.name}: workspace", describe_headline(found), describe_verdict(found),
        describe_inputs(found), sections, found.warnings, r.RobotPicture(robot), r.Provenance(robot=robot),
        lambda: build_points_table(found), found,
    )  # fmt: skip


def _list_facts(found: Study) -> list[tuple[str, str, str]]:
    """Return the facts shown in large numbers: words, number, unit."""
    space, frame = found.workspace, found.workspace.footprint
    name, unit = space.measure
    rows = [(name, r.format_number(space.size.value, 3), SIZE_UNITS[unit])]
    if space.dimension == 3 and frame.area > 0:
        rows.append(("workspace per footprint", r.format_number(space.size.value / frame.area, 2), "m³/m²"))
        if frame.height > 0:
            rows.append(
                ("workspace per installation", r.format_number(space.size.value / frame.area / frame.height, 2), "")
            )
    for quantity, which, words in (
        ("stiffness", 0, "least"),
        ("resonance", 0, "least"),
        ("speed", 0, "least"),
        ("condition", 1, "median"),
    ):
        if quantity in found.catalogue.rows and np.isfinite(found.catalogue.rows[quantity].spread.median):
            value, _, shown_unit = format_shown_value(quantity, found.catalogue.rows[quantity].spread[which]).partition(
                " "
            )
            rows.append((f"{quantity}, {words}", value, shown_unit))
    return rows[:6]


def _build_space(found: Study) -> Iterator[r.Element]:
    yield r.Figures([r.SpacePicture(found)], "whole")
    walls = [o.name for o in found.workspace.judge.demands.surroundings.obstacles]
    named = f" Outlined in colour: {', '.join(walls)} (walls without end are not drawn)." if walls else ""
    yield r.explain(f"The border of the workspace with the robot at home in it; dashed: the box around it.{named}")


def _build_sections(found: Study) -> Iterator[r.Element]:
    drawn = [build_section_figure(found, s) for s in found.sections]
    cart = "rods' joints on carts, at home" if found.workspace.machine.rods is not None else "base"
    reasons = [r.Key(get_reason_ink(kind), kind) for kind in list_reasons(found)]
    yield r.Figures(drawn, "row", [r.Key("in", "workspace"), *reasons, r.Key("cart", cart)])
    yield r.Figures(drawn[:_MAX_SECTIONS], on=r.On.NOTEBOOK)
    areas = [f"{r.replace_minus_signs(s.name)}: {r.format_number(s.area, 3)} m²" for s in found.sections]
    yield r.explain(
        "Coloured: inverse kinematics has a solution there; the colour is the first demand that is not met. Cross: the "
        f"tool at home. {', '.join(areas)}."
    )


def _build_reasons(found: Study) -> r.ResultTable:
    """Return the demands that points fail first, over the studied box."""
    columns = [
        r.Column("first demand not met"), r.Column("", "bar"),
        r.Column("share of the box searched", "number", on=r.On.DRAWN),
        r.Column("share of box", "number", on=r.On.TERMINAL), r.Column("by", style="quiet"),
    ]  # fmt: skip
    rows = []
    for row in found.workspace.counts():
        share = r.format_percent(100 * row["share"])
        by = [f"{name} ({r.format_percent(100 * n / row['points'])})" for name, n in list(row["culprits"].items())[:4]]
        bar = r.Bar(row["share"], ink=get_reason_ink(row["reason"]))
        rows.append(r.Row([row["reason"], bar, share, share, ", ".join(by)]))
    return r.ResultTable(columns, rows, style="reasons", on=r.On.ALL)


def _build_catalogue(found: Study) -> Iterator[r.Element]:
    catalogue = found.catalogue
    titles = (("least", ""), ("median", "strong"), ("largest", ""), ("at home", ""))
    columns = [r.Column("over the workspace"), *(r.Column(title, "number", style) for title, style in titles)]
    rows = [
        r.Row([QUANTITIES[name].words, *(format_shown_value(name, v) for v in (*row.spread, row.home))])
        for name, row in catalogue.rows.items()
    ]
    length = f" Turns count as lengths at {catalogue.length:.3g} m." if catalogue.length else ""
    left: list[r.Element] = [
        r.ResultTable(columns, rows, on=r.On.PRINTED),
        r.explain(f"Stiffness: {catalogue.elasticity}.{length}", on=r.On.PRINTED),
        *_build_extremes(found),
    ]
    if catalogue.stiffness_at_home is not None:
        values, axes = catalogue.stiffness_at_home
        main = [
            r.Row([name, format_shown_value("stiffness", float(value)), f"along ({_format_axis(axis)})"])
            for name, value, axis in zip(("softest", "between", "stiffest"), values, axes.T, strict=True)
        ]
        left.append(r.Text("Stiffness at home, by direction", "heading"))
        left.append(r.ResultTable([r.Column(), r.Column(kind="number", style="strong"), r.Column(kind="number")], main))
    right: list[r.Element] = []
    if found.tilt is not None:
        picture = r.PolarPicture(
            found.tilt.towards, np.rad2deg(found.tilt.angle), "how far the tool leans towards each side"
        )
        right = [r.Text("How far the tool leans", "heading"), r.Figures([picture], "whole"),
                 r.explain(_describe_tilt(found), on=r.On.PRINTED)]  # fmt: skip
    demands = r.tabulate_plainly(_list_demands(found))
    areas = [f"{r.replace_minus_signs(s.name)}: {r.format_number(s.area, 3)} m²" for s in found.sections]
    if areas:
        left.append(r.Text(f"Cross-sections {r.format_list(areas)}.", on=r.On.TERMINAL))
    yield r.Beside(left, [*right, r.Text("Conditions of a pose", "heading"), demands], "two")


def _build_extremes(found: Study) -> Iterator[r.Element]:
    """Yield the points of the smallest and largest values of the springs' maps, and their intervals at home."""
    rows, figures = [], found.catalogue
    for name, row in figures.rows.items():
        if name in ELASTIC_MAPS and row.least is not None and row.largest is not None:
            interval = "–"
            if row.home_ci95 is not None:
                low, high = (format_shown_value(name, x) for x in row.home_ci95)
                interval = f"{low.partition(' ')[0]} … {high}"
            rows.append(
                r.Row(
                    [QUANTITIES[name].words, _format_place(row.least.place), _format_place(row.largest.place), interval]
                )
            )
    if rows:
        titles = ("least at [m]", "largest at [m]", "95 % interval at home")
        yield r.ResultTable(
            [r.Column("springs"), *(r.Column(title, "number") for title in titles)], rows, on=r.On.PRINTED
        )
        where = f"Springs are linearised at {r.count(int(figures.evaluated.sum()), 'place')} of the workspace."
        errors = found.quality.elasticity.stiffness_stderr
        stated = "" if errors is None else f" {int((errors > 0).sum())} of {len(errors)} springs have a standard error."
        yield r.explain(where + stated, on=r.On.PRINTED)


def _format_place(place: np.ndarray) -> str:
    return ", ".join(r.replace_minus_signs(f"{x:.3g}") for x in place)


def _format_axis(axis: np.ndarray) -> str:
    return ", ".join(r.replace_minus_signs(f"{c:+.2f}") for c in axis)


def _build_maps(found: Study) -> Iterator[r.Element]:
    for name in found.maps:
        if not any(np.isfinite(s.maps[name]).any() for s in found.sections):
            yield r.Text(r.capitalise(QUANTITIES[name].words), "heading")
            yield r.explain(f"{r.capitalise(found.catalogue.elasticity) if name in ELASTIC_MAPS else 'Unknown'}.")
            continue
        quantity = QUANTITIES[name]
        unit = SHOWN_UNITS[quantity.unit][1]
        yield r.Text(r.capitalise(quantity.words) + (f" [{unit}]" if unit else ""), "heading")
        yield r.Figures([build_scale(found, name)], "whole")
        yield r.Figures([build_map_figure(found, s, name) for s in found.sections], "row")
        yield r.explain(MAP_WORDS[name])


def _describe_tilt(found: Study) -> str:
    assert found.tilt is not None
    rows = found.tilt.to_dict()
    place = ", ".join(f"{x:.3g}" for x in found.tilt.place)
    by = r.format_list(sorted({row for row in found.tilt.reason if row}), 4)
    limited = f" Stopped by {by}." if by else ""
    return (
        f"At ({place}) m the tool leans {rows['every_way_deg']:.0f}° towards every side and "
        f"{rows['best_way_deg']:.0f}° towards the best.{limited}"
    )


def _list_demands(found: Study) -> list[tuple[str, str]]:
    space = found.workspace
    demands, frame = space.judge.demands, space.footprint
    rows = [("actuators", "within the robot file's limits" if demands.actuators else "not limited")]
    if space.judge.balls is not None:
        limits = np.rad2deg(np.unique(space.judge.balls.limits[np.isfinite(space.judge.balls.limits)]))
        axes = "given by the robot file" if space.judge.balls.given.all() else "the rods' directions at home"
        rows.append(
            ("ball joints", f"{r.format_list([f'{x:.4g}°' for x in limits])} from their axes, which are {axes}")
        )
    apart = f"come closer than {1e3 * demands.clearance:.4g} mm" if demands.clearance else "touch"
    pairs = (
        f"none of {len(space.judge.pairs)} pairs of solids may {apart}" if space.judge.pairs else "no solids to test"
    )
    rows.append(("collisions", pairs if demands.collisions else "not asked"))
    rows.append(("singularities", f"same side as home, condition number below {demands.condition:g}"))
    around = demands.surroundings
    ends = [f"{a} {lo:.4g} to {hi:.4g} m" for a, lo, hi in zip("xyz", around.lower, around.upper, strict=True)
            if np.isfinite([lo, hi]).any()]  # fmt: skip
    rows += [("tool", r.format_list(ends))] if ends else []
    rows += [("obstacles", r.format_list([o.name for o in around.obstacles], 12))] if around.obstacles else []
    rows += [("border", f"{demands.border:g} m kept")] if demands.border else []
    size = frame.upper - frame.lower
    if frame.area > 0:
        rows.append(
            (
                "footprint",
                f"{size[0]:.3g} × {size[1]:.3g} m = {frame.area:.3g} m², {frame.height:.3g} m high: {frame.what}",
            )
        )
    return rows


def format_shown_value(name: str, value: float, digits: int = 3) -> str:
    """Return a quantity's value with its unit in readable form."""
    if not np.isfinite(value):
        return "unknown" if np.isnan(value) else "∞"
    factor, unit = SHOWN_UNITS[QUANTITIES[name].unit]
    return f"{r.format_number(factor * value, digits)} {unit}".strip()


def describe_size(found: Study) -> str:
    """Return the size with its bounds, such as `1.98 m³ (1.93 … 2.03)`."""
    size, (_, unit) = found.workspace.size, found.workspace.measure
    half = (size.high - size.low) / 2
    digits = int(np.clip(np.ceil(-np.log10(max(half, 1e-9))) + 1, 0, 6))
    return f"{size.value:.{digits}f} {SIZE_UNITS[unit]} ({size.low:.{digits}f} … {size.high:.{digits}f})"


def describe_headline(found: Study) -> str:
    """Return the headline."""
    space = found.workspace
    extent = space.upper - space.lower
    sides = " × ".join(f"{x:.2f}" for x, n in zip(extent, space.lattice.shape, strict=True) if n > 1)
    return f"The tool reaches {describe_size(found)} within {sides} m, connected to home."


def describe_verdict(found: Study) -> r.Verdict:
    """Return the verdict on the reliability of the numbers."""
    space = found.workspace
    half = (space.size.high - space.size.low) / 2 / max(space.size.value, 1e-12)
    level: r.Level = "good" if half < 0.1 else "care" if half < 0.25 else "poor"
    words = f"Bounds of its size: {r.format_percent(100 * half)} to either side"
    advice = "" if level == "good" else f"; half the step of {r.format_number(space.lattice.step, 2)} m halves them"
    badge = {"good": "Sharp", "care": "Rough", "poor": "Too rough"}[level]
    return r.Verdict(level, f"{words}{advice}. {describe_limits(found)}", badge)


def describe_limits(found: Study) -> str:
    """Return the demand that reduces the workspace most, other than the robot's reach."""
    rows = [row for row in found.workspace.counts() if row["reason"] != "out of reach"]
    rows.sort(key=lambda row: -row["points"])
    if not rows:
        return "Only the robot's reach limits it."
    named = [f"{row['reason']} ({r.format_percent(100 * row['share'])})" for row in rows[:3]]
    return f"Besides reach it is limited by {r.format_list(named)} of the box searched."


def describe_inputs(found: Study) -> str:
    """Return a summary of the study."""
    space = found.workspace
    size = " × ".join(str(n) for n in space.lattice.shape)
    return (
        f"{size} points every {r.format_number(space.lattice.step, 3)} m, {r.count(space.judge.n_judged, 'pose')} "
        "evaluated; the rest follows from neighbours and a random check"
    )
