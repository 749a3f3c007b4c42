"""Whether what appeared is what a page shows: words alike, numbers to the digits shown, `...` for whatever is left out."""

from __future__ import annotations

import re

_NUMBER = r"[-+−]?\d+(?:\.\d+)?(?:e[-+−]?\d+)?"
_PIECE = re.compile(rf"(?P<skip>\.\.\.)|(?P<bar>[█▉▊▋▌▍▎▏╱]+)|(?P<number>(?<![\w.]){_NUMBER}(?![\w]))|(?P<space>\s+)")


def differences(shown: str, came: str) -> str:
    """Return the first line shown that did not come, beside what came instead; nothing where all of it came.

    A line of `...` stands for any number of lines, `...` within a line for any text. Blank lines and widths of gaps do not
    count, nor do the lengths of bars. A number is met where it differs by no more than one in the last digit shown.
    """
    rows, lines = _lines(shown), _lines(came)
    ends = {0}  # numbers of lines that may have been used up by the rows so far
    for k, row in enumerate(rows):
        if row.strip() == "...":
            ends = set(range(min(ends), len(lines) + 1))
            continue
        met = {n + 1 for n in ends if n < len(lines) and alike(row, lines[n])}
        if not met:
            free = k > 0 and rows[k - 1].strip() == "..."
            instead = "nothing like it" if free else lines[max(ends)] if max(ends) < len(lines) else "the end"
            return f"shown: {row.strip()}\n came: {instead.strip()}"
        ends = met
    if len(lines) not in ends:
        return f"shown: the end\n came: {lines[max(ends)].strip()}"
    return ""


def alike(shown: str, came: str) -> bool:
    """Whether a line is as shown."""
    pattern, numbers, at = [], [], 0
    for m in _PIECE.finditer(shown.strip()):
        pattern.append(re.escape(shown.strip()[at : m.start()]))
        at = m.end()
        if m["number"]:
            numbers.append(m["number"])
        pattern.append(
            {"skip": ".*", "bar": "[█▉▊▋▌▍▎▏╱]*", "number": f"({_NUMBER})", "space": r"\s+"}[m.lastgroup or ""]
        )
    pattern.append(re.escape(shown.strip()[at:]))
    found = re.fullmatch("".join(pattern), came.strip())
    return found is not None and all(map(_near, numbers, found.groups()))


def _near(shown: str, came: str) -> bool:
    digits, _, power = shown.replace("−", "-").partition("e")
    last = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    return abs(float(shown.replace("−", "-")) - float(came.replace("−", "-"))) <= 1.01 * last


def _lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip()]
