"""The feedforward of a robot whose loops are solved numerically, as C99: Newton's method from the last configuration.

A function for gap and Jacobian stands beside the forces, called a bounded number of times.
"""

from __future__ import annotations

from collections.abc import Iterator

from tau_dyn.control.export_c_graph import yield_graph_lines, yield_output_lines
from tau_dyn.control.export_c_linear import FACTOR, SOLVE, SOLVE_T
from tau_dyn.control.export_c_newton import ITERATIONS, STEP, STEPS
from tau_dyn.control.export_c_text import format_numbers
from tau_dyn.control.export_model import Program

CLOSED = 1e-9
"""Largest gap left [m]."""


def yield_closing_lines(program: Program, name: str) -> Iterator[str]:
    """Yield the functions that close the loops: `closed(start, q)` is the one to call, `name_start` sets home."""
    loops, graph = program.loops, program.closure
    assert loops is not None and graph is not None
    robot, n = program.feedforward.model.robot, len(loops.passive)
    yield from "\n\n".join((FACTOR, SOLVE, SOLVE_T)).splitlines()
    yield ""
    yield f"/* Gap of every loop [m] and, of those solved, the derivative by the {n} passive joints. */"
    outputs = f"double gap[{len(program.gap)}], double J[{n * n}]"
    yield f"static void closure(const double q[{robot.na}], const double p[{n}], {outputs})"
    yield "{"
    flat = [x for row in program.jacobian for x in row]
    yield from yield_graph_lines(graph, [*program.gap, *flat])
    yield from yield_output_lines("gap", program.gap)
    yield from yield_output_lines("J", flat)
    yield "}"
    yield ""
    home = [*robot.home, *loops.home[loops.passive]]
    text = _CLOSE.replace("@NAME@", name).replace("@NA@", str(robot.na)).replace("@NP@", str(n))
    text = text.replace("@NG@", str(len(program.gap))).replace("@HOME@", ", ".join(format_numbers(home)))
    text = text.replace("@ROWS@", ", ".join(str(r) for r in loops.rows)).replace("@STEP@", repr(STEP))
    text = (
        text.replace("@STEPS@", str(STEPS)).replace("@ITERATIONS@", str(ITERATIONS)).replace("@CLOSED@", repr(CLOSED))
    )
    yield from text.splitlines()


_CLOSE = """\
static const double home[@NA@ + @NP@] = {@HOME@};
static const int solved[@NP@] = {@ROWS@};

void @NAME@_start(double start[@NA@ + @NP@])
{
    for (int k = 0; k < @NA@ + @NP@; ++k) start[k] = home[k];
}

/* Newton's method on the passive joints p at drives q; 0 where it does not end with closed loops. */
static int newton(const double *q, double *p)
{
    double gap[@NG@], J[@NP@ * @NP@], step[@NP@];
    int rows[@NP@];
    for (int k = 0; k < @ITERATIONS@; ++k) {
        double most = 0.0, size = 0.0;
        closure(q, p, gap, J);
        if (!factor(@NP@, J, rows)) return 0;
        for (int i = 0; i < @NP@; ++i) step[i] = -gap[solved[i]];
        solve(@NP@, J, rows, step);
        for (int i = 0; i < @NP@; ++i) if (fabs(step[i]) > most) most = fabs(step[i]);
        for (int i = 0; i < @NP@; ++i) p[i] += most > 0.5 ? step[i] * 0.5 / most : step[i];
        for (int i = 0; i < @NG@; ++i) if (!(fabs(gap[i]) <= size)) size = fabs(gap[i]);
        if (size < 1e-7) return most < @CLOSED@ * 1e3; /* the step just taken leaves its square */
    }
    return 0;
}

/* Follow the drives from start to q in bounded steps; start is moved along only where this ends well. */
static int closed(double *start, const double *q)
{
    double at[@NA@], p[@NP@], far = 0.0;
    for (int k = 0; k < @NP@; ++k) p[k] = start[@NA@ + k];
    for (int k = 0; k < @NA@; ++k) if (!(fabs(q[k] - start[k]) <= far)) far = fabs(q[k] - start[k]);
    if (!(far <= @STEP@ * @STEPS@)) return 0;
    const int steps = far > @STEP@ ? (int)ceil(far / @STEP@) : 1;
    for (int i = 1; i <= steps; ++i) {
        for (int k = 0; k < @NA@; ++k) at[k] = i == steps ? q[k] : start[k] + (q[k] - start[k]) * i / steps;
        if (!newton(at, p)) return 0;
    }
    for (int k = 0; k < @NA@; ++k) start[k] = q[k];
    for (int k = 0; k < @NP@; ++k) start[@NA@ + k] = p[k];
    return 1;
}"""
