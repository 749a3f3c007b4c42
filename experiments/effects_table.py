"""Which causes can be named, by which law, from which motion? Writes `docs/reference/causes.md` from the effects' own words.

    python experiments/effects_table.py

A test compares the page with the classes, so the two cannot drift apart.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tau_dyn.effects import EFFECTS, LOOP_CAUSES, Effect, Scene, spell_unit
from tau_dyn.files import write_whole
from tau_dyn.simulate import SERVO_ENTRIES

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "causes.md"

INTRODUCTION = """# Causes

`diagnose` may name each of these; their files, one a family, are in `src/tau_dyn/effects/`. v > 0 is forward, `encoder - load` is
what the encoder reads beyond the load. Units are those of a slide; a hinge has N m for N and rad for m.
`simulate --effects E.yaml` hides any of them but `friction_change`, which takes two logs, and `torque_speed_limit`, which a log
of the delivered force does not have. With temperature, the simulated
`temp_room` warms from 20 towards 40 degC with a time constant of one minute.

This page is written by `experiments/effects_table.py`.

"""
LOOP_INTRODUCTION = """
## In a servo's loop

From commands and positions alone; numbers are entries of the servo's law, whose file says what they are.

"""
LOOP_COLUMNS = ("cause", "equation", "parameters", "what reveals it", "mistaken for")
COLUMNS = ("cause", "equation", "parameters", "settings", "range", "what reveals it", "mistaken for", "reference")


def page() -> str:
    """Return the page."""
    rows = [_row(cls) for cls in EFFECTS.values() if cls.cause]
    lines = [_line(COLUMNS), _line(("---",) * len(COLUMNS)), *map(_line, rows)]
    loops = [
        (f"`{name}`", f"`{c.equation}`", ", ".join(f"`{e}` [{SERVO_ENTRIES[e].unit}]" for e in c.entries), c.reveals,
         ", ".join(c.mistaken_for))
        for name, c in LOOP_CAUSES.items()
    ]  # fmt: skip
    more = [_line(LOOP_COLUMNS), _line(("---",) * len(LOOP_COLUMNS)), *map(_line, loops)]
    return INTRODUCTION + "\n".join(lines) + "\n" + LOOP_INTRODUCTION + "\n".join(more) + "\n"


def _row(cls: type[Effect]) -> tuple[str, ...]:
    settings = (f"`{key}` {_unit(cls.setting_units.get(key, ''))}".strip() for key in cls.defaults)
    twins = "".join(f"; exactly: {name}" for name in cls.equivalent)
    others = [name for name in cls.mistaken_for if name not in cls.equivalent]
    return (
        f"`{cls.name}`",
        f"`{cls.equation}`",
        ", ".join(_parameters(cls)),
        ", ".join(settings),
        _ranges(cls),
        cls.reveals,
        (", ".join(others) + twins).removeprefix("; "),
        cls.reference,
    )


def _ranges(cls: type[Effect]) -> str:
    """Return the plausible ranges; a quantity is named where there are several."""
    several = len({one.quantity for one in cls.plausible}) > 1
    texts = (
        one.describe() if several else one.describe().removeprefix(one.quantity.replace("_", " "))
        for one in cls.plausible
    )
    short = "; ".join(text.strip().replace("of the joint's", "of its") for text in texts)
    return re.sub(r"-([\d.e+]+(?: [^;]+?)?) to \1", r"±\1", short)


def _parameters(cls: type[Effect]) -> list[str]:
    """Return names and units of an effect's parameters on one slide, or two where it takes two."""
    joints = ("JOINT",) if _takes_one(cls) else ("JOINT", "OTHER")
    shown = {}
    for settings in ({}, {"displaced": 1}) if "displaced" in cls.defaults else ({},):
        effect = cls(joints, ["N"] * len(joints), **settings)  # type: ignore[arg-type]
        shown |= {p.name: f"`{p.name}` {_unit(p.unit)}".strip() for p in effect.parameters}
    return list(shown.values())


def _takes_one(cls: type[Effect]) -> bool:
    one, two = np.ones(1), np.ones(2)
    alone = cls.groups(Scene(("a",), ("N",), -one, one, one, one, 1.0, 1.0, frozenset(cls.needs)))
    both = cls.groups(
        Scene(("a", "b"), ("N", "N"), -two, two, two, two, 1.0, 1.0, frozenset(cls.needs), coupled=(("a", "b"),))
    )
    return bool(alone) or not both


def _unit(unit: str) -> str:
    text = spell_unit(unit, "N")
    return "" if text in ("", "1") else f"[{text}]"


def _line(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def main(path: Path = PAGE) -> None:
    """Write the page."""
    write_whole(path, page())


if __name__ == "__main__":
    main()
