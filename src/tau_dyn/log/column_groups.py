"""Groups of columns of a log, one column for each joint, found from the words and numbers in their names.

A name is split into words. The joint's name or the last number identifies the joint; the remaining words identify quantity and
unit. Columns with the same words are a group, which counts if it has every joint. If no group of a kind has every joint, the one
with most joints counts, filled from columns whose other words denote the same kind.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from tau_dyn.log.column_names import format_names, split_column_name, split_words
from tau_dyn.message_codes import CodedWarning

_WORDS: Mapping[str, frozenset[str]] = {
    "reference": frozenset("target goal cmd command commanded desired des ref reference setpoint sp d action".split()),
    "current": frozenset("current currents curr cur i iq ampere amps amp motorcurrent".split()),
    "tau": frozenset("tau torque torques effort efforts trq moment moments force forces".split()),
    "v": frozenset("v vel velocity velocities speed speeds dq qd qdot omega".split()),
    "a": frozenset("a acc acceleration accelerations ddq qdd".split()),
    "q": frozenset("q qm pos position positions angle angles theta state enc encoder encoders".split()),
    "temp": frozenset("temp temperature temperatures".split()),
    "other": frozenset(
        "tcp tool ee cartesian pose ext external volts voltage error fric friction con load contact enable enabled flag".split()
    ),
}
"""Words of a name by the kind that they denote; the first row with a match decides, after `other` and `reference`."""

CLOCKS = frozenset(
    "t time timestamp timestamps datetime stamp clock zeit zeitstempel uhrzeit temps hora tijd secs seconds".split()
)

_MEASURED = frozenset("actual act measured meas".split())
"""Words that make a group a better candidate."""


class ColumnGroup(NamedTuple):
    """Columns of one name, one for each joint, with their kind and the words of their name."""

    kind: str  # a signal, `q_ref`, `current`, `other`, or empty
    stem: tuple[str, ...]
    columns: tuple[str, ...]  # in the robot's order; empty for a joint without one
    by_name: bool
    more: int = 0  # numbers beyond the joints
    filled: tuple[str, ...] = ()  # columns of other words or of a shorter joint's name
    bare: bool = False  # whether only the joints' names say that these are positions

    def score(self) -> tuple[bool, int]:
        """Return a rank of how likely the group holds the measured quantity."""
        return self.by_name, len(_MEASURED & set(self.stem)) - ("filt" in self.stem or "filtered" in self.stem)


def _classify(words: Sequence[str]) -> str:
    """Return the kind of quantity that a name's words denote; empty if they denote no kind."""
    known = set(words)
    if known & _WORDS["other"]:
        return "other"
    kind = next((k for k in ("current", "tau", "v", "a", "q", "temp") if known & _WORDS[k]), "")
    if known & _WORDS["reference"]:
        if "action" in known:
            return "q_ref"
        return {"q": "q_ref", "": "q_ref", "tau": "tau_ref"}.get(kind, "other")
    return kind


def find_groups(columns: Sequence[str], joints: Sequence[str], file: str) -> list[ColumnGroup]:
    """Return the groups of columns that have every joint, by its name or by numbers."""
    stems: dict[tuple[str, ...], dict[int | str, str]] = {}
    for column in columns:
        for stem, key in _split_joint(column, joints):
            stems.setdefault(stem, {}).setdefault(key, column)
    groups = []
    for stem, found in stems.items():
        by_name = all(joint in found for joint in joints)
        numbers = sorted(key for key in found if isinstance(key, int))
        more = 0
        if by_name:
            order = tuple(found[joint] for joint in joints)
        elif len(joints) == 1 and "" in found:
            order = (found[""],)
        elif len(numbers) >= len(joints) and numbers[0] in (0, 1) and np.all(np.diff(numbers) == 1):
            order = tuple(found[key] for key in numbers[: len(joints)])
            more = len(numbers) - len(joints)
        else:
            continue
        kind = _classify(stem) or ("" if not set(stem) <= {"joint", "axis", "j"} else _classify(split_words(file)))
        groups.append(ColumnGroup(kind, stem, order, by_name, more))
    if not any(group.kind == "q" for group in groups):  # a column of the joint's name alone holds its position
        groups = [g._replace(kind="q", bare=True) if g.by_name and not g.stem and not g.kind else g for g in groups]
    whole = {group.kind for group in groups}
    return [*groups, *_find_partial_groups(stems, columns, joints, set(_PARTIAL) - whole)]


_PARTIAL: tuple[str, ...] = ("q", "v", "tau", "q_ref")
"""Kinds for which a map may lack a joint."""


def _find_partial_groups(
    stems: Mapping[tuple[str, ...], Mapping[int | str, str]],
    columns: Sequence[str],
    joints: Sequence[str],
    kinds: set[str],
) -> Iterator[ColumnGroup]:
    """Yield the group with most joints of each of these kinds, filled from columns whose other words denote the kind."""
    named = {stem: {j: found[j] for j in joints if j in found} for stem, found in stems.items()}
    for kind in sorted(kinds):
        alike = sorted((s for s in named if named[s] and _classify(s) == kind), key=lambda s: -len(named[s]))
        if not alike:
            continue
        found = dict(named[alike[0]])
        taken = {column for group in named.values() for column in group.values()}
        left = [column for column in columns if column not in taken]
        for joint in joints:
            others = [named[s][joint] for s in alike[1:] if joint in named[s]]
            near = others or [c for c in left if _nearly_names(c, joint, joints, kind)]
            if joint not in found and len(near) == 1:
                found[joint] = near[0]
        filled = tuple(column for joint, column in found.items() if joint not in named[alike[0]])
        yield ColumnGroup(kind, alike[0], tuple(found.get(j, "") for j in joints), True, filled=filled)


def _nearly_names(column: str, joint: str, joints: Sequence[str], kind: str) -> bool:
    """Return whether a column is of a kind and has the words that distinguish a joint's name from the others."""
    words, own = split_words(column), set(split_words(joint))
    mark = own - set.intersection(*(set(split_words(j)) for j in joints))
    return bool(mark) and mark <= set(words) and _classify([w for w in words if w not in own]) == kind


def _split_joint(column: str, joints: Sequence[str]) -> Iterator[tuple[tuple[str, ...], int | str]]:
    """Yield a column's words without its joint, and the joint's name or number."""
    ours = split_column_name(column)
    if ours is not None and ours[1] in joints:
        yield split_words(ours[0]), ours[1]
        return
    words = split_words(column)
    for joint in sorted(joints, key=len, reverse=True):
        part = split_words(joint)
        for at in range(len(words) - len(part) + 1):
            if part and words[at : at + len(part)] == part:
                yield words[:at] + words[at + len(part) :], joint
                return
    numbers = [k for k, word in enumerate(words) if word.isdigit()]
    if numbers and len(words) > 1:
        k = numbers[-1]
        yield words[:k] + words[k + 1 :], int(words[k][:9])
    yield words, ""


def choose_group(groups: Sequence[ColumnGroup], kind: str) -> tuple[ColumnGroup | None, list[str]]:
    """Return the likeliest group of a kind, and a warning if others are as likely."""
    found = sorted((g for g in groups if g.kind == kind), key=ColumnGroup.score, reverse=True)
    others = [g.columns[0] for g in found[1:] if g.score() == found[0].score()]
    if not others:
        return (found[0] if found else None), []
    sentence = (
        f"{found[0].columns[0]} is taken for {kind}, and {format_names(others)} could be as well; choose by hand."
    )
    return found[0], [CodedWarning("column_unsure", sentence)]
