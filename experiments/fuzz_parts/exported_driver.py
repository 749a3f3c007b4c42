"""A driver in C that calls one exported function many times with hostile numbers, and counts the statuses.

Five kinds of inputs in turn: near home; anywhere in and a little beyond the joints' ranges; near home with NaN, infinities,
denormals, huge and far numbers among them, or one of these alone; a random walk; ends of ranges, zeros and right angles, where
singular places are. The program is compiled with the address and undefined-behaviour sanitizers. Status 0 must come with
outputs within their bounds and, where a `check` is given, with right ones; any other status with outputs and state as they were.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass, field
from hashlib import blake2b
from pathlib import Path

import numpy as np

from tau_dyn.codegen.c_writer import MAX_NUMBER, list_numbers

ODD = (
    "NAN", "INFINITY", "-INFINITY", "5e-324", "-1e-310", "0.0", "-0.0", "1e200", "-1e200", "1e308", "-1e308",
    f"{MAX_NUMBER!r}", f"{-1.1 * MAX_NUMBER!r}", "1e6", "-1e6", "40.0", "-3.0", "1e-12",
)  # fmt: skip
SANITIZED = ("-std=c99", "-O2", "-g", "-Wall", "-Wextra", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")

CHANCE = """
static uint64_t seed = 1;
static double chance(void)
{
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) / 9007199254740992.0;
}
static const double odds[] = {@ODD@};
static double odd(void) { return odds[(int)(chance() * (sizeof odds / sizeof *odds))]; }
"""

_DRIVER = """
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "@NAME@.h"
@CHANCE@
static double pick(int mode, double near, double spread, double low, double high, double *walk)
{
    const double grid[] = {near, 0.0, low, high, 0.5 * (low + high), M_PI / 2, -M_PI / 2, M_PI, -M_PI};
    if (mode == 1) return low + (high - low) * chance();
    if (mode == 2 && chance() < 0.15) return odd();
    if (mode == 3) return *walk = fmin(fmax(*walk + 0.03 * (high - low) * (2.0 * chance() - 1.0), low), high);
    if (mode == 4) return grid[(int)(chance() * (sizeof grid / sizeof *grid))];
    return near + spread * (2.0 * chance() - 1.0);
}
/* R is turned by up to an angle about any axis (Rodrigues). */
static void turned(double most, double *R)
{
    double w[3], S[9], size = 0.0;
    for (int k = 0; k < 3; ++k) {
        w[k] = 2.0 * chance() - 1.0;
        size += w[k] * w[k];
    }
    const double angle = most * chance(), s = sin(angle), c = 1.0 - cos(angle);
    size = sqrt(size);
    if (!(size > 0.1)) return;
    for (int j = 0; j < 3; ++j) {
        const double x[3] = {R[j], R[3 + j], R[6 + j]};
        for (int k = 0; k < 3 && j == 0; ++k) w[k] /= size;
        const double a[3] = {w[1] * x[2] - w[2] * x[1], w[2] * x[0] - w[0] * x[2], w[0] * x[1] - w[1] * x[0]};
        const double b[3] = {w[1] * a[2] - w[2] * a[1], w[2] * a[0] - w[0] * a[2], w[0] * a[1] - w[1] * a[0]};
        for (int i = 0; i < 3; ++i) S[3 * i + j] = x[i] + s * a[i] + c * b[i];
    }
    memcpy(R, S, sizeof S);
}
int main(int count, char **given)
{
    const long calls = count > 1 ? atol(given[1]) : 1;
    long counts[8] = {0};
    seed = count > 2 ? (uint64_t)atol(given[2]) : 1;
    (void)turned, (void)pick;
@ARRAYS@
    for (long i = 0; i < calls; ++i) {
        const int mode = i % 5;
        (void)mode;
        if (i % 50 == 0) { @BEGIN@ }
@FILL@
@PREPARE@
        memcpy(before, state, sizeof before);
        const int status = @CALL@;
        if (status < 0 || status > 7) return 1;
        ++counts[status];
@BOUNDS@
        if (status && memcmp(before, state, KEPT * sizeof *state)) {
            printf("call %ld, status %d: the state is another one", i, status);
            return 1;
        }
        for (int k = 0; k < KEPT; ++k) if (!status && !(fabs(state[k]) <= @MOST@)) {
            printf("call %ld, status 0: state[%d] = %g", i, k, state[k]);
            return 1;
        }
        if (!status) {
            double off = 0.0;
            (void)off;
@CHECK@
            if (!(off < 1e-6)) { printf("call %ld: status 0 and off by %g", i, off); return 1; }
        }
    }
    for (int k = 0; k < 8; ++k) printf("%ld ", counts[k]);
    return 0;
}
"""


@dataclass(frozen=True, eq=False)
class Inputs:
    """What an array of inputs may hold.

    Attributes:
        near: A good state (n,).
        spread: How far from it the calm calls go.
        low: Least values of the wide calls (n,).
        high: Largest values of the wide calls (n,).
        rotation: Whether it is a rotation (9,), turned as a whole where a call is wide.
    """

    near: np.ndarray
    spread: float
    low: np.ndarray
    high: np.ndarray
    rotation: bool = False


@dataclass(frozen=True, eq=False)
class Call:
    """One function of an exported program.

    Attributes:
        text: The call, with arrays by name.
        inputs: By array.
        outputs: Array -> least and largest values (n,) that may come with status 0.
        state: Numbers of the state, 0 for none.
        kept: How many of them an error must leave alone; by default all.
        begin: C that sets the state.
        prepare: C that changes the inputs.
        check: C that adds to `off` what answers with status 0 are wrong by.
        stops: Whether outputs are zero after an error, as a velocity has to be; otherwise an error leaves them alone.
    """

    text: str
    inputs: dict[str, Inputs]
    outputs: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    state: int = 0
    kept: int | None = None
    begin: str = ""
    prepare: str = ""
    check: str = ""
    stops: bool = False


def fill_chance(text: str) -> str:
    """Return C with its source of random and of odd numbers."""
    return text.replace("@CHANCE@", CHANCE).replace("@ODD@", ", ".join(ODD)).replace("@MOST@", repr(MAX_NUMBER))


def count_statuses(
    sources: tuple[str, str], name: str, call: Call, folder: Path, calls: int, seed: int = 1
) -> list[int]:
    """Return how often each status 0 to 7 came.

    Raises:
        AssertionError: A promise was broken, or a sanitizer spoke.
    """
    arrays = [f"    double state[{call.state or 1}] = {{0}}, before[{call.state or 1}];"]
    arrays.append(f"    enum {{ KEPT = {call.state if call.kept is None else call.kept} }};")
    fill, bounds, refused = [], [], "0.0" if call.stops else "-7.0"
    for x, given in call.inputs.items():
        n = len(given.near)
        for what in ("near", "low", "high"):
            values = np.broadcast_to(getattr(given, what), n)
            arrays.append(f"    static const double {x}_{what}[{n}] = {{{list_numbers(values)}}};")
        arrays.append(f"    double {x}[{n}], {x}_walk[{n}]; memcpy({x}_walk, {x}_near, sizeof {x}_near);")
        mode = "mode == 2 ? 2 : 0" if given.rotation else "mode"
        fill.append(
            f"        const double same_{x} = mode == 2 && chance() < 0.1 ? odd() : 0.0;\n"
            f"        for (int k = 0; k < {n}; ++k)\n            {x}[k] = same_{x} != 0.0 ? same_{x} : pick({mode}, {x}_near[k], "
            f"{given.spread!r}, {x}_low[k], {x}_high[k], {x}_walk + k);"
        )
        if given.rotation:
            fill.append(f"        if (mode != 0 && mode != 2) turned(mode == 1 ? M_PI : 0.3, {x});")
    for x, (low, high) in call.outputs.items():
        n = len(low)
        for what, values in (("least", low), ("most", high)):
            arrays.append(f"    static const double {x}_{what}[{n}] = {{{list_numbers(values)}}};")
        arrays.append(f"    double {x}[{n}];")
        fill.append(f"        for (int k = 0; k < {n}; ++k) {x}[k] = -7.0;")
        bounds.append(
            f"        for (int k = 0; k < {n}; ++k)\n"
            f"            if (status ? {x}[k] != {refused} : !({x}[k] >= {x}_least[k] && {x}[k] <= {x}_most[k])) {{\n"
            f'                printf("call %ld, status %d, {x}[%d] = %g", i, status, k, {x}[k]); return 1;\n            }}'
        )
    text = fill_chance(_DRIVER.replace("@NAME@", name))
    blanks = {"ARRAYS": arrays, "FILL": fill, "BOUNDS": bounds, "BEGIN": [call.begin], "PREPARE": [call.prepare]}
    for blank, lines in (blanks | {"CALL": [call.text], "CHECK": [call.check]}).items():
        text = text.replace(f"@{blank}@", "\n".join(lines))
    for file, content in ((f"{name}.c", sources[0]), (f"{name}.h", sources[1]), ("driver.c", text)):
        (folder / file).write_text(content)
    return run_sanitized([folder / f"{name}.c", folder / "driver.c"], folder / "driver", calls, seed)


def run_sanitized(files: list[Path], program: Path, calls: int, seed: int = 1) -> list[int]:
    """Compile with sanitizers, run, and return the counts that are printed."""
    objects = [str(_compile(file)) for file in files]
    subprocess.run(["cc", *SANITIZED, *objects, "-o", str(program), "-lm"], check=True)
    done = subprocess.run([str(program), str(calls), str(seed)], capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr[:2000]}"
    return [int(x) for x in done.stdout.split()]


def _compile(file: Path) -> Path:
    """Return a source's object file; that of an exported program serves the drivers of all its functions."""
    object_file = file.with_name(f"{file.stem}_{blake2b(file.read_bytes(), digest_size=8).hexdigest()}.o")
    if not object_file.exists():
        subprocess.run(["cc", *SANITIZED, "-D_DEFAULT_SOURCE", "-c", str(file), "-o", str(object_file)], check=True)
    return object_file
