"""Values that readers trip over: numbers at the edge of their types, names that mean something elsewhere, text in odd codings."""

from __future__ import annotations

from random import Random

NUMBERS = (
    "nan", "-nan", "inf", "-Infinity", "1e308", "-1e308", "1e309", "5e-324", "0", "-0", "-1", "1", "2", "1e-12", "1e15", "3.5",
    "9" * 400, "0x7fffffffffffffff", "1_000", "1e", "1,5", "٣", "１２", "+", "-", ".", "1e5e5", "1.0.0", "1:1:1:1", "0b1", "0o17",
    "9223372036854775808", "-9223372036854775809", "4294967296", "true", "null",
)  # fmt: skip
"""Numbers as text, and what is nearly one."""

WORDS = (
    "", " ", "\t", "~", "None",
    "a" * 3000, "é", "e\u0301", "\u202egnp", "\x1b[31mred", "\x07", "\x7f", "\u2028", "\ufeff",
    "../../../../etc/passwd", "/etc/passwd", "/dev/zero", "file:///etc/passwd", "package://x/../../y", "C:\\x", "a/b", "..", ".",
    "<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "' onload='x", "</script>", "]]>",
    "<!--", "{{7*7}}", "{% x %}",
    "=1+1", "+1", "-1+1", "@SUM(1)", "=cmd|' /C calc'!A0", "${1/0}", "${9**9**9}", "$(env HOME)", "$(eval 1)",
    "%s%n", "{0}", "q_", "t",
    "__class__", "tau_", "x_tool", "base_link", "all", "*", "[", "[a-", "?", "cart1.mass", "nan", "0",
)  # fmt: skip
"""Names and cells."""

GARBAGE = (
    b"\x00",
    b"\xff\xfe",
    b"\xef\xbb\xbf",
    b"\xed\xa0\x80",
    b"\xc0\xaf",
    b"\r",
    b"\r\n",
    b"\n\n",
    b"\x1a",
    b"\x85",
    b"\x0b",
    b'"',
    b"'",
    b"#",
)
"""Bytes that a text should not hold where they stand."""


def number(rng: Random) -> str:
    """Return a number as text, hostile or plain."""
    if rng.random() < 0.3:
        return repr(rng.choice((1, -1)) * 10 ** rng.uniform(-12, 16))
    return rng.choice(NUMBERS)


def word(rng: Random) -> str:
    """Return a hostile name."""
    return rng.choice(WORDS)


def value(rng: Random) -> str:
    """Return a number or a word."""
    return number(rng) if rng.random() < 0.6 else word(rng)
