"""`tau-dyn export --to shaper` and `--to notch`: C that keeps a controller's commands from exciting resonances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Group, Parameter

from tau_dyn.cli import arguments as args
from tau_dyn.exceptions import InputError

_FILTERS = Group("--to shaper, notch")
_RESULTS = (".json", ".yaml", ".yml")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """What shapers and notch filters take.

    Attributes:
        shaper: Kind of input shaper
        mode: Numbers of the modes, slowest first, from 1; several are treated one after the other
        tolerated: Residual vibration of an EI shaper at the mode's estimate
    """

    shaper: Annotated[Literal["zv", "zvd", "ei"], Parameter(group=_FILTERS)] = "zvd"
    mode: Annotated[tuple[args.Whole, ...], Parameter(group=_FILTERS, consume_multiple=args.SEVERAL, metavar="N")] = (
        1,
    )
    tolerated: Annotated[args.Positive, Parameter(group=_FILTERS, metavar="X")] = 0.05


@dataclass(frozen=True)
class WrittenFilter:
    """A filter as C.

    Attributes:
        files: Source and header.
        said: One line for a person.
        result: The JSON result's part.
        warnings: Sentences.
    """

    files: dict[Path, str | Callable[[Path], None]]
    said: str
    result: dict[str, Any]
    warnings: tuple[str, ...]


def write_filter(
    to: str,
    source: Path,
    out: Path,
    dt: float,
    name: str | None,
    options: FilterOptions,
    robot_options: args.RobotOptions,
) -> WrittenFilter:
    """Return a shaper or a notch filter for modes of a result, a model of `modes`, or a robot with springs.

    Args:
        to: `shaper` or `notch`.
        source: Where the modes are.
        out: The C file; its header goes beside it.
        dt: The controller's step [s].
        name: With which all functions begin; the format's name where it is None.
        options: Kind and modes.
        robot_options: How to load a robot.
    """
    from tau_dyn.codegen import include_header, locate_header

    modes, warnings = _choose_modes(source, options, robot_options)
    make = _make_shaper if to == "shaper" else _make_notch
    code, declared, said, result = make(modes, dt, name or to, options)
    header = locate_header(out)
    shown = [
        {
            "frequency_hz": m.frequency_hz,
            "damping_ratio": m.damping_ratio,
            "frequency_ci95": list(m.frequency_interval),
            "damping_ci95": list(m.damping_interval),
            **own,
        }
        for m, own in zip(modes, result.pop("modes"), strict=True)
    ]
    files: dict[Path, Any] = {out: include_header(code, name or to, header), header: declared}
    made = {"period": dt, "modes": shown, **result}
    return WrittenFilter(files, f"{said} -> {out} and {header}", made, tuple(warnings))


def _choose_modes(source: Path, options: FilterOptions, robot_options: args.RobotOptions):
    """Return the modes asked for, and warnings."""
    from tau_dyn.control.vibration import Resonance, read_resonances

    if source.suffix.lower() in _RESULTS:
        found, warnings = read_resonances(source), []
    else:
        from tau_dyn.mechanism import FlexibleModel

        robot = robot_options.load(str(source))
        found = [Resonance(m.frequency_hz, m.damping_ratio) for m in FlexibleModel(robot).at().modes()]
        warnings = [
            f"modes of {robot.name} are those of its springs at home, actuators held; they change with the pose"
        ]
    odd = [n for n in options.mode if not 1 <= n <= len(found)]
    if odd:
        listed = ", ".join(f"{k} at {m.frequency_hz:.4g} Hz" for k, m in enumerate(found, start=1))
        raise InputError("bad_option", f"--mode {odd[0]}: {source.name} has {listed or 'no mode that rings'}")
    chosen = [found[n - 1] for n in dict.fromkeys(options.mode)]
    if not any(m.frequency_stderr for m in chosen):
        warnings.append(
            f"{source.name} has no standard errors; what is left of vibration is stated for the modes as they are"
        )
    return chosen, warnings


def _make_shaper(modes, dt: float, name: str, options: FilterOptions):
    """Return source, header, a line and the result of a shaper."""
    from tau_dyn.codegen import write_shaper_source
    from tau_dyn.control.vibration import combine_shapers, compute_residual_vibration, design_shaper

    whole = combine_shapers([design_shaper(options.shaper, m, options.tolerated) for m in modes])
    taps = whole.sampled(dt)
    left = [
        {
            "residual_at_estimate": float(compute_residual_vibration(taps, m.frequency_hz, m.damping_ratio)),
            "residual_over_interval": taps.find_worst_residual(m),
        }
        for m in modes
    ]
    words = [
        f"Mode at {m.frequency_hz:.6g} Hz, damping ratio {m.damping_ratio:.4g}: it leaves "
        f"{100 * x['residual_at_estimate']:.3g} % of vibration, {100 * x['residual_over_interval']:.3g} % at most over the "
        "95 % intervals."
        for m, x in zip(modes, left, strict=True)
    ]
    code, declared = write_shaper_source(taps, dt, name, words)
    worst = 100 * max(x["residual_over_interval"] for x in left)
    longer = f"{options.shaper} shaper for {_list_hz(modes)}: {whole.duration:.4g} s longer"
    said = f"{longer}, leaves {worst:.3g} % of vibration at most"
    result = {
        "modes": left,
        "shaper": options.shaper,
        "times": whole.times.tolist(),
        "amplitudes": whole.amplitudes.tolist(),
        "sampled": {"times": taps.times.tolist(), "amplitudes": taps.amplitudes.tolist()},
    }
    return code, declared, said, result


def _make_notch(modes, dt: float, name: str, options: FilterOptions):
    """Return source, header, a line and the result of a notch filter."""
    from tau_dyn.codegen import write_notch_source
    from tau_dyn.control.vibration import design_causal_notch

    notch = design_causal_notch(modes, dt)
    gains = [
        {
            "gain_at_estimate": float(abs(notch.response([m.frequency_hz])[0])),
            "gain_over_interval": notch.find_worst_gain(m),
        }
        for m in modes
    ]
    words = [
        f"Mode at {m.frequency_hz:.6g} Hz: gain {x['gain_at_estimate']:.3g}, {x['gain_over_interval']:.3g} at most over the 95 % "
        "interval of its frequency."
        for m, x in zip(modes, gains, strict=True)
    ]
    code, declared = write_notch_source(notch, name, words)
    worst = max(x["gain_over_interval"] for x in gains)
    said = f"notch filter for {_list_hz(modes)}: gain {worst:.3g} at most over the 95 % intervals of the frequencies"
    return code, declared, said, {"modes": gains, "sections": notch.sections.tolist()}


def _list_hz(modes) -> str:
    return ", ".join(f"{m.frequency_hz:.4g} Hz" for m in modes)
