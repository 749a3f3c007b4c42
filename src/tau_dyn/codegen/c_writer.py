"""The parts common to all exported C files.

A file is fixed texts of the folder `c`, their `@BLANKS@` filled, and functions written from graphs. It has no allocation,
no recursion and no header beyond `math.h`. Every exported function refuses inputs and outputs that are not finite or beyond
`MAX_NUMBER`; then it returns a status above zero and leaves its outputs alone.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np

from tau_dyn.exceptions import InputError

MAX_NUMBER = 1e9  # m, rad, N, N m and their rates, far above any machine; a larger number is a fault, not a state
STEP, STEPS, ITERATIONS = 0.05, 100, 12
"""Largest step of a drive at once [m or rad], most steps a call, most Newton iterations a step, where loops are solved."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,40}")
_KEYWORDS = frozenset(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register restrict "
    "return short signed sizeof static struct switch typedef union unsigned void volatile while main".split()
)
_MATH = frozenset(
    "acos asin atan atan2 cos sin tan acosh asinh atanh cosh sinh tanh exp exp2 expm1 frexp ilogb ldexp log log10 log1p "
    "log2 logb modf scalbn scalbln cbrt fabs hypot pow sqrt erf erfc lgamma tgamma ceil floor nearbyint rint lrint llrint "
    "round lround llround trunc fmod remainder remquo copysign nan nextafter nexttoward fdim fmax fmin fma j0 j1 jn y0 y1 "
    "yn gamma signgam fpclassify isfinite isinf isnan isnormal signbit NAN INFINITY HUGE_VAL NULL double_t float_t".split()
)
"""Names that `math.h` declares or defines; each function also with the suffixes `f` and `l`."""


def fill_template(name: str, flags: Collection[str] = (), **blanks: object) -> str:
    """Return a text of the folder `c`: parts between `@IF FLAG@` and `@END@` where the flag is given, `@BLANKS@` filled."""
    text = files("tau_dyn.codegen").joinpath("c", f"{name}.c").read_text(encoding="utf-8")
    text = re.sub(r"@IF (\w+)@\n(.*?)@END@\n", lambda m: m[2] if m[1] in flags else "", text, flags=re.DOTALL)
    text = re.sub(r"@(\w+)@", lambda m: str(blanks[m[1]]) if m[1] in blanks else m[0], text)
    return text.replace("@MOST@", repr(MAX_NUMBER)).rstrip("\n")


def list_numbers(values: Iterable[float] | np.ndarray) -> str:
    """Return numbers as C reads them back to the last digit, for the inside of braces."""
    return ", ".join(repr(float(x)) for x in np.ravel(np.asarray(values, float)))


def format_table(kind: str, name: str, values: Iterable[object], size: object = "") -> str:
    """Return a constant array, wrapped at the usual width."""
    rows, row = [], ""
    for x in values:
        word = repr(x) if isinstance(x, int) else repr(float(x))  # type: ignore[arg-type]
        if len(row) + len(word) > 108:
            rows.append(row)
            row = ""
        row += f"{word}, "
    text = "\n    ".join(r.rstrip() for r in [*rows, row.rstrip(", ")])
    return f"static const {kind} {name}[{size}] = {{\n    {text}\n}};"


def require_c_name(name: str, taken: Collection[str] | None = None) -> str:
    """Return a name for a function of C, or for the beginning of several.

    Args:
        name: The name.
        taken: Names that the source itself uses, where the function is called just this; None if more follows it.

    Raises:
        InputError: It is no identifier of C, or means something else in the source.
    """
    if not _NAME.fullmatch(name) or name in _KEYWORDS:
        raise InputError(
            "invalid_value",
            f"'{name}' cannot name a function in C; use letters, digits and underscores, a letter first",
        )
    if taken is not None and (name in taken or name in _MATH or name[:-1] in _MATH and name[-1] in "fl"):
        raise InputError(
            "invalid_value", f"'{name}' cannot name a function in C, where it means something else; take another name"
        )
    return name


def build_identifiers(names: Iterable[str]) -> list[str]:
    """Return names as parts of C identifiers, each different: other characters become `_`, repetitions get a number."""
    out: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9_]", "_", name)[:40] or "_"
        found, k = plain, 2
        while found in out:
            found, k = f"{plain}_{k}", k + 1
        out.append(found)
    return out


def escape_comment_line(line: str) -> str:
    """Return one line of a comment in plain ASCII that cannot end the comment early.

    `*/` ends a comment, `/*` and trigraphs draw warnings, invisible characters can make text look like code.
    """
    plain = line.encode("ascii", "backslashreplace").decode("ascii")
    plain = re.sub(r"[\x00-\x1f\x7f]", " ", plain)
    for wrong, right in (("*/", "* /"), ("/*", "/ *"), ("??", "? ?")):
        while wrong in plain:
            plain = plain.replace(wrong, right)
    return plain.rstrip("\\ ")


def format_header(name: str, words: Iterable[str], declared: Sequence[str]) -> str:
    """Return a header: a description, then declarations that C and C++ accept."""
    guard = f"{name.upper()}_H"
    said = "\n".join(f" * {escape_comment_line(line)}".rstrip() for line in words)
    frame = ["#ifdef __cplusplus", 'extern "C" {', "#endif"], ["#ifdef __cplusplus", "}", "#endif"]
    top = ["/*", said, " */", f"#ifndef {guard}", f"#define {guard}", ""]
    return "\n".join([*top, *frame[0], "", *declared, "", *frame[1], f"#endif /* {guard} */", ""])


def format_source(name: str, first: str, parts: Iterable[str]) -> str:
    """Return a source file of several parts that includes its header and `math.h`."""
    top = f"/* {escape_comment_line(first)} Units, joints and provenance: {name}.h */"
    return f'{top}\n#include "{name}.h"\n\n#include <math.h>\n\n' + "\n\n".join(parts) + "\n"


def locate_header(source: Path) -> Path:
    """Return the path of a source file's header.

    Raises:
        InputError: A folder is there, or C could not include a file of that name.
    """
    header = source.with_suffix(".h")
    if header.is_dir():
        raise InputError("cannot_write", f"{header} is a folder; the header would be written there")
    if not re.fullmatch(r"[A-Za-z0-9_.+ -]+", header.name):
        raise InputError(
            "invalid_value",
            f"{header.name}: a C file includes its header by name; use letters, digits, _, -, + and dots",
        )
    return header


def include_header(text: str, name: str, header: Path) -> str:
    """Return a source's text that includes its header under the name of its file."""
    return text.replace(f'#include "{name}.h"', f'#include "{header.name}"', 1).replace(
        f": {name}.h */", f": {header.name} */", 1
    )
