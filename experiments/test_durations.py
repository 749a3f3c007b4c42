"""Which tests take longer than a second? Writes `tests/long_tests.txt`, from which the fast tier is chosen.

    python -m pytest -m "not slow" --junitxml=out/tests.xml
    python experiments/test_durations.py out/tests.xml

In: a JUnit file of a run of all tests on a quiet machine. A function counts as its longest case, with its share of set-up.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from defusedxml.ElementTree import parse

from tau_dyn.files import write_whole

MIN_LONG_S = 1.0
"""Duration from which a test is long [s]."""
RECORD = Path(__file__).resolve().parents[1] / "tests" / "long_tests.txt"


def read_durations(path: Path) -> dict[str, float]:
    """Return the longest duration [s] of each test function, by file and name."""
    found: dict[str, float] = {}
    for case in parse(path).getroot().iter("testcase"):
        *folders, last = case.get("classname", "").split(".")
        parts = [*folders, last]
        inner = [] if last.startswith("test_") else [parts.pop()]  # a class within a file
        name = "::".join(["/".join(parts) + ".py", *inner, case.get("name", "").partition("[")[0]])
        found[name] = max(found.get(name, 0.0), float(case.get("time", "0")))
    return found


def main(path: Path) -> None:
    """Write the record."""
    rows = [(seconds, name) for name, seconds in read_durations(path).items() if seconds > MIN_LONG_S]
    lines = [f"{seconds:.1f} {name}" for seconds, name in sorted(rows, reverse=True)]
    text = "\n".join(["# Seconds of the longest case; experiments/test_durations.py", *lines, ""])
    write_whole(RECORD, text)
    print(f"{len(lines)} long tests, {sum(seconds for seconds, _ in rows):.0f} s")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("junit", type=Path)
    main(parser.parse_args().junit)
