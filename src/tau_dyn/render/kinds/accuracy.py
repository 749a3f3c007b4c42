"""Accuracy: the map, all methods on the same errors, limits of simple bounds, measurements."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from tau_dyn import results as r
from tau_dyn.kinematics.accuracy import AccuracyResult
from tau_dyn.kinematics.assumptions import Guideway
from tau_dyn.render.kinds import accuracy_figures as figures
from tau_dyn.render.kinds.accuracy_figures import format_size
from tau_dyn.render.presentation import present_kind

SMALL_SHARE = 0.1
"""Departure from the exact worst case up to which a linear bound counts as good."""

METHOD_WORDS = {
    "linear": "Jacobian of the actuators; along their motion only",
    "parallelepiped": "all errors, to first order (A.4)",
    "ellipsoid": "ellipsoidal shells intersected (A.2)",
    "exact": "all errors, constraints solved",
    "certified": "proved upper bound",
    "montecarlo": "worst of the random draws",
}
SHOWN_OFF = 0.002
"""Departure from exact below which a map of it would show only rounding errors."""
MAX_P_VALUE = 0.01
"""Largest p-value at which a cycle along a guideway is reported."""


@present_kind.register
def present_accuracy(found: AccuracyResult, *, files: Sequence[tuple[str, str]] = ()) -> r.Presentation:
    """Return the presentation of accuracy.

    Args:
        found: The result.
        files: Name and hash of every measured file.
    """
    a, grid, robot = found.accuracy, found.grid, found.robot
    over = "" if grid is None else f"Over the section {r.replace_minus_signs(grid.section.words)}"
    known, measured = a is not None, bool(found.measured.sentences)
    sections = [
        r.Chapter("map", over, lambda: _build_maps(found), r.On.DRAWN, when=known and grid is not None),
        r.Chapter("methods", "Every method on the same errors", lambda: _build_methods(found), r.On.ALL, when=known),
        r.Chapter("linear", "Where the simple bounds fail", lambda: _build_failures(found), when=known),
        r.Chapter("bodies", "Where the tool may be", lambda: _build_bodies(found), when=bool(found.bodies)),
        r.Chapter(
            "measured", "Results of the measured points", lambda: _build_measured(found), r.On.ALL, when=measured
        ),
    ]
    return r.Presentation(
        "Accuracy of", robot.name, f"{robot.name}: accuracy", r.end_sentence(describe_headline(found)), describe_verdict(found),
        describe_inputs(found), sections, (), r.RobotPicture(robot),
        r.Provenance(logs=[("measured", name, sha256) for name, sha256 in files], robot=robot), lambda: _tabulate(found), found,
    )  # fmt: skip


def _tabulate(found: AccuracyResult) -> dict[str, np.ndarray]:
    """Return one row per pose: actuated positions [m or rad], tool position [m], the largest error by each method [m]."""
    a = found.accuracy
    if a is None:
        return {}
    columns = {f"q_{j}": a.q[:, k] for k, j in enumerate(found.robot.actuated)}
    columns |= {f"{axis}_tool": a.position[:, k] for k, axis in enumerate("xyz")}
    return columns | {f"largest_{m}": x for m, x in a.largest.items()}


def _build_maps(found: AccuracyResult) -> Iterator[r.Element]:
    a = found.accuracy
    assert a is not None
    maps = [figures.build_error_map(found, a.best_method)]
    yield r.Figures(maps[:1], on=r.On.NOTEBOOK)
    maps += [figures.build_usual_map(found)] if a.usual.size and np.isfinite(a.usual).any() else []
    yield r.Figures([*maps, *([figures.build_turn_map(found)] if a.turned else [])], "maps")
    lost = ", or no largest error" if found.lost.any() else ""
    yield r.explain(
        "Largest: the worst that errors within their bounds can do at that pose. Squares: guideways. White: not "
        f"reached{lost}. The orientation is home's. Values above the scale's top, two in a hundred, share its last "
        "colour."
    )


def _build_methods(found: AccuracyResult) -> Iterator[r.Element]:
    a = found.accuracy
    assert a is not None
    columns = [
        r.Column("method"), r.Column("what it is", style="quiet", on=r.On.PAGE), r.Column("least", "number"),
        r.Column("median", "number"),
        r.Column("largest", "number", "strong"), r.Column("off from exact, from", "number", on=r.On.PAGE),
        r.Column("to", "number", on=r.On.PAGE),
        r.Column("off from exact", "number", on=r.On.TERMINAL), r.Column("poses without", "number", on=r.On.PAGE),
        r.Column("largest at", "unit", "quiet", on=r.On.PRINTED, spare=True),
    ]  # fmt: skip
    yield r.ResultTable(columns, [_build_method(found, m) for m in a.largest], style="methods", on=r.On.ALL)
    for method, why in a.left_out.items():
        yield r.explain(f"{method} is left out: {why}.", on=r.On.PRINTED)
    drawn = (
        f"Monte Carlo: {a.samples} draws a pose, uniform within the bounds; it approaches the worst case from below "
        "and shows the usual case. "
        if a.samples
        else ""
    )
    yield r.explain(
        f"Negative: the method promises too much accuracy. {drawn}Proved: no errors within the bounds exceed it, shown "
        "by a contraction argument."
    )
    if a.turned:
        yield r.Text("Change of orientation", "heading")
        rows = [r.Row([m, _milli(np.nanmedian(x)), _milli(np.nanmax(x))]) for m, x in a.turned.items()]
        yield r.ResultTable(
            [r.Column("method"), r.Column("median", "number"), r.Column("largest", "number", "strong")],
            rows,
            style="fitted",
        )
    measured = ", from the measured points (95 % of them)" if found.from_measured else ""
    yield r.Text(f"Assumed errors{measured}", "heading")
    yield r.tabulate_plainly(_list_assumed(found))


def _build_method(found: AccuracyResult, method: str) -> r.Row:
    a, s = found.accuracy, found.summary(method)
    assert a is not None
    off = a.off(method) if "exact" in a.largest and method != "exact" else np.full(1, np.nan)
    there = np.isfinite(off).any()
    low, high = (format_share(float(f(off))) if there else "" for f in (np.nanmin, np.nanmax)) if there else ("", "")
    where = describe_place(a.position[s.worst_pose]) if np.isfinite(s.most) else "–"
    return r.Row([
        method, METHOD_WORDS[method], format_size(s.least), format_size(s.median), format_size(s.most), low, high,
        f"{low} … {high}" if there else "", str(s.unanswered or ""), where,
    ])  # fmt: skip


def _milli(radians: float) -> str:
    return f"{r.format_number(1e3 * float(radians), 3)} mrad" if np.isfinite(radians) else "–"


def _list_assumed(found: AccuracyResult) -> list[tuple[str, str]]:
    a = found.accuracy
    if a is None:
        return []
    rows = []
    for joint, error in a.errors.actuators.items():
        unit = found.robot.position_units[found.robot.actuated.index(joint)]
        if error.axes is not None:
            said = ", ".join(f"{format_size(x)} in {axis}" for axis, x in zip("xyz", error.axes, strict=True))
        elif unit == "rad":
            said = f"{r.format_number(1e3 * error.along, 3)} mrad"
        elif error.across is None:
            said = f"{format_size(error.along)} along its motion"
        elif error.across == error.along:
            said = f"{format_size(error.along)} in all directions"
        else:
            said = f"{format_size(error.along)} along, {format_size(error.across)} across its motion"
        rows.append((joint, said))
    for rod, error in a.errors.rods.items():
        parts = (("length", error.length), ("base joint", error.base), ("plate joint", error.plate))
        rows.append((rod, ", ".join(f"{what} {format_size(x)}" for what, x in parts if x)))
    return rows


def _build_failures(found: AccuracyResult) -> Iterator[r.Element]:
    a, g = found.accuracy, found.growth
    assert a is not None
    linear = [m for m in ("linear", "parallelepiped", "ellipsoid") if m in a.largest]
    if found.grid is not None and "exact" in a.largest:
        known = [m for m in linear if np.isfinite(a.off(m)).any() and np.nanmax(np.abs(a.off(m))) > SHOWN_OFF]
        if known:
            yield r.Figures([figures.build_departure_map(found, m) for m in known], "maps")
            yield r.explain(
                "Difference from the exact worst case. The linear bound knows the actuators' motion alone and leaves "
                "out what goes across the guideways; the ellipsoids of Appendix A.2 are thinner than the sets that "
                "they stand for."
            )
    figure = figures.build_growth_figure(found)
    if figure is None or g is None:
        return
    yield r.Text("How large errors may be", "heading")
    key = r.build_key(residual="linear", first="parallelepiped", shells="ellipsoid", proved="certified")
    rows = [r.Row([m, _times(g.holds_to(m, 0.01)), _times(g.holds_to(m, 0.1))]) for m in linear if m in g.largest]
    columns = [r.Column("bound"), r.Column("within 1 % up to", "number"), r.Column("within 10 % up to", "number")]
    said = (
        "Times the stated errors, at the worst pose. A line that ends: beyond it errors can take the robot into a "
        "singularity, or no bound is proved."
    )
    yield r.Beside(
        [r.Figures([figure], "wide-chart", key)],
        [r.ResultTable(columns, rows, style="fitted"), r.explain(said)],
        "pairs",
    )


def _times(factor: float) -> str:
    return f"× {r.format_number(factor, 4)}" if np.isfinite(factor) else "never"


def _build_bodies(found: AccuracyResult) -> Iterator[r.Element]:
    a = found.accuracy
    assert a is not None
    boxed = [r.Key("box", "parallelepiped")] if len(found.bodies[0].corners) else []
    key = [r.Key("cloud", "random errors"), *boxed, r.Key("residual", "worst case")]
    titles = ("Worst pose, nearest home",) if len(found.bodies) == 1 else ("Nearest home", "Worst pose")
    for k, (title, body) in enumerate(zip(titles, found.bodies, strict=False)):
        size = format_size(float(np.linalg.norm(body.worst)))
        yield r.Text(f"{title}: {size} at {describe_place(a.position[body.pose])}", "heading")
        yield r.Figures(figures.build_body_figures(body), "bodies", () if k else key)
    yield r.explain(
        "Displacement from the intended position, seen along z, y and x. The longest diagonal is the direction in "
        "which the tool errs most."
    )


def _build_measured(found: AccuracyResult) -> Iterator[r.Element]:
    seen = found.measured
    said = [format_sentence(s) for s in seen.sentences]
    yield r.Listing(said)
    told = said if found.accuracy is not None else said[1:]  # the first sentence is the headline
    if told:
        yield r.Listing(told, on=r.On.SCREENS)
    if seen.guideways:
        titles = (
            "points",
            "error, mean",
            "std",
            "95 % along",
            "95 % across",
            "bow",
            "scale error [10⁻⁶]",
            "cycle",
            "backlash",
        )
        columns = [r.Column("guideway"), *(r.Column(title, "number") for title in titles)]
        yield r.ResultTable(columns, [_build_guideway(line) for line in seen.guideways])
        yield r.Group(
            [r.Figures([f for line in seen.guideways for f in figures.build_guideway_figures(line)], "pairs")], ""
        )
        alike = [
            f" {g.joint}: points at such distances cannot separate this cycle from one of "
            f"{', '.join(map(format_size, g.cycle.aliases))}."
            for g in seen.guideways
            if g.cycle is not None and g.cycle.p_value <= MAX_P_VALUE and g.cycle.aliases
        ]
        yield r.explain(
            "Distance of each measured point from the best straight line: along the motion, where the drive errs, and "
            f"across it, where the guideway does. ± is one standard error (1 σ).{''.join(alike)}"
        )
    if seen.orientation is not None:
        yield r.Text("Orientation of the plate", "heading")
        key = r.build_key(predicted="α", residual="β", expected="γ")
        yield r.Figures([figures.build_orientation_figure(seen.orientation)], "wide-chart", key)
        pole = "β is near 0° or 180°, where α and γ trade against each other; only their sum or difference means something. "
        yield r.explain(
            f"{pole if seen.orientation.near_pole else ''}A pattern that repeats from layer to layer comes from the "
            "rods; a drift along the guideways from carts that turn."
        )


def _build_guideway(line: Guideway) -> r.Row:
    along, across = line.bounds()
    scale, stderr = line.scale
    cycle = line.cycle
    wave = "–" if cycle is None or cycle.p_value > MAX_P_VALUE else (
        f"amplitude {format_size(cycle.amplitude)}, period {format_size(cycle.period)}")  # fmt: skip
    slack = "–" if line.backlash is None else f"{format_size(line.backlash.size)} ± {format_size(line.backlash.stderr)}"
    sizes = line.sizes
    return r.Row([
        line.joint, str(len(line.q)), *map(format_size, (float(sizes.mean()), float(sizes.std(ddof=1)), along, across)),
        f"{format_size(line.bow.size)} ± {format_size(line.bow.stderr)}",
        f"{r.format_number(1e6 * scale, 3)} ± {r.format_number(1e6 * stderr, 2)}", wave, slack,
    ])  # fmt: skip


def format_share(value: float) -> str:
    """Return a departure from the exact value, such as `−12 %`, `< 0.1 %`."""
    if not np.isfinite(value):
        return "–"
    if abs(value) < 0.001:
        return "< 0.1 %"
    return f"{'+' if value > 0 else '−'}{r.format_percent(100 * abs(value))}"


def format_sentence(sentence: str) -> str:
    """Return a sentence of a result with typographic signs."""
    return r.replace_plus_minus(sentence).replace(" um", " µm").replace(" deg", "°")


def describe_place(position: np.ndarray) -> str:
    """Return a tool position in words."""
    return (
        ", ".join(
            f"{name} {r.format_number(round(float(x), 4) + 0.0, 3)}" for name, x in zip("xyz", position, strict=True)
        )
        + " m"
    )


def describe_headline(found: AccuracyResult) -> str:
    """Return the headline."""
    a = found.accuracy
    if a is None:
        return found.measured.sentences[0] if found.measured.sentences else "Nothing was measured."
    if not np.isfinite(a.largest[a.best_method]).any():
        return "No pose keeps its assembly mode for all errors within the bounds"
    s = found.summary(a.best_method)
    start = f"The tool is off by {format_size(s.most)} at most, by {format_size(s.median)} at the median pose"
    if found.lost.any():
        start = (
            f"Where the robot keeps its pose, the tool is off by {format_size(s.most)} at most, "
            f"{format_size(s.median)} at the median pose"
        )
    usual = (
        f"; 95 % of random errors stay below {format_size(float(np.nanmax(a.usual)))}"
        if np.isfinite(a.usual).any()
        else ""
    )
    return start + usual


def describe_verdict(found: AccuracyResult) -> r.Verdict:
    """Return the verdict on the validity of the numbers."""
    a = found.accuracy
    if a is None:
        seen = found.measured
        wrong = any(p.sure for p in seen.parallel) or any(g.shape < 0.01 or g.bow.sure for g in seen.guideways)
        said = "The nominal model's assumptions fail beyond the scatter; the sections below show by how much."
        if wrong:
            return r.Verdict("care", said, "Assumptions fail")
        return r.Verdict("good", "No assumption fails beyond the scatter of these points.", "Assumptions hold")
    lost = int(found.lost.sum())
    if lost:
        poses = f"{r.count(lost, 'pose')} of {len(a.q)}"
        said = f"At {poses} errors within the bounds can reach a singularity; no bound exists there."
        return r.Verdict("poor", said, "May lose its pose")
    if "exact" not in a.largest:
        return r.Verdict(
            "care", "Without the exact worst case the quality of the other bounds is unknown.", "Not compared"
        )
    off = {m: a.off(m) for m in ("linear", "parallelepiped", "ellipsoid") if m in a.largest}
    worst = {m: float(np.nanmax(np.abs(x))) for m, x in off.items() if np.isfinite(x).any()}
    bad = [m for m, x in worst.items() if x > SMALL_SHARE]
    if bad:
        words = r.format_list([f"{m} by up to {r.format_percent(100 * worst[m])}" for m in bad])
        said = f"Simple bounds are off: {words}; the exact worst case is the one to use."
        return r.Verdict("care", said, "Use the exact bound")
    said = "The linear bounds are as good as exact here; errors are small against the rods and no singularity is near."
    proved = "certified" in a.largest and bool(np.isfinite(a.largest["certified"]).all())
    return r.Verdict("good", said, "Bound proved" if proved else "Bound not proved")


def describe_inputs(found: AccuracyResult) -> str:
    """Return a summary of the inputs."""
    a = found.accuracy
    if a is None:
        return f"{found.robot.source}; measured points only, no errors to carry to the tool."
    where = (
        r.count(len(a.q), "pose")
        if found.grid is None
        else f"{r.count(len(a.q), 'pose')} of the section {r.replace_minus_signs(found.grid.section.words)}"
    )
    source = ", from measured points" if found.from_measured else ""
    names = [*a.errors.actuators, *a.errors.rods]
    return f"{found.robot.source}, {where}; errors of {r.format_list(names)}{source}."
