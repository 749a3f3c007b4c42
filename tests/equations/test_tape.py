"""Tapes: a graph as a list of operations gives array code's numbers, to the last bit, from NumPy and from the C library."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tau_dyn.equations import Graph, Tape, as_expression_array, build_inputs, find_compiler, find_tape, tape


@pytest.fixture(params=["numpy", "c"])
def run(request):
    """Run a tape by each backend."""
    if request.param == "numpy":
        return lambda tape, rows, out: tape.run(rows, out)
    if find_compiler() is None:
        pytest.skip("no C compiler")
    library = tape._LIBRARIES.build(tape._SOURCE)
    return lambda tape, rows, out: tape.run(rows, out, library)


def mix(x, y, z):
    """Return rows that use every operation, a sum that is an output and an argument, an input, and one row twice."""
    total = x + y * 3.0
    turned = np.cos(z) * total - np.sin(z) / x
    return [total, -turned, turned * turned - total, y, total, 0.0 * x, 2.5 + 0.0 * x]


def build_tape() -> Tape:
    graph = Graph()
    x = build_inputs(graph, "x", np.array([0.3, 0.5, 0.7]))
    return Tape(graph, list(x), list(np.ravel(as_expression_array(mix(*x)))))


@pytest.mark.parametrize("n", [0, 1, 2, 63, 64, 65, 1023, 1025])
def test_a_tape_gives_the_numbers_of_array_code(run, rng, n: int) -> None:
    """Sums, products, quotients, signs, sines and cosines are those of NumPy, bit by bit, for any number of samples."""
    rows = rng.uniform(0.5, 2, (3, n))
    out = np.zeros((7, n + 5))[:, :n]
    run(build_tape(), rows, out)
    assert_array_equal(out, np.array(mix(*rows)).reshape(7, n))


def test_a_tape_fills_a_part_of_wider_rows(run, rng) -> None:
    """Only the samples asked for are written, and the inputs stay as they are."""
    rows, out = rng.uniform(0.5, 2, (3, 70)), np.full((7, 200), np.nan)
    before = rows.copy()
    run(build_tape(), rows, out[:, 100:170])
    assert np.isfinite(out[:5, 100:170]).all() and np.isnan(out[:, :100]).all() and np.isnan(out[:, 170:]).all()
    assert np.isnan(out[5]).all()  # a row of zeros is left alone
    assert_array_equal(rows, before)


def test_threads_share_a_tape(run, rng) -> None:
    """A tape holds no numbers of a run, so runs in several threads at once give what one after the other gives."""
    given, one = rng.uniform(0.5, 2, (8, 3, 4000)), build_tape()
    apart, together = np.zeros((2, 8, 7, 4000))
    for rows, out in zip(given, apart, strict=True):
        run(one, rows, out)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(partial(run, one), given, together))
    assert_array_equal(together, apart)


def test_a_condition_or_an_unknown_operation_has_no_tape() -> None:
    """Operations that tapes lack are refused, and their caller keeps the array code."""
    graph = Graph()
    (x,) = build_inputs(graph, "x", np.array([2.0]))
    for odd in (np.sin(x * 2.0), np.tanh(x), np.where(x > 1.0, x, 2.0 * x).item()):
        with pytest.raises(TypeError):
            Tape(graph, [x], [odd])
    assert find_tape("odd", tape.TRACE_FROM, lambda: Tape(graph, [x], [np.tanh(x)])) is None
    if x > 1.0:
        with pytest.raises(TypeError, match="condition"):
            Tape(graph, [x], [x * 2.0])


def test_tracing_and_building_wait_until_the_samples_justify_them(monkeypatch) -> None:
    """A short computation is not traced; a library is looked for from the first trace on, and built only for many samples."""
    asked = []
    monkeypatch.setattr(tape, "_get_library", asked.append)
    assert find_tape("waits", tape.TRACE_FROM - 1, lambda: pytest.fail("it is traced early")) is None and not asked
    found = find_tape("waits", tape.TRACE_FROM, build_tape)
    assert found is not None and found[1] is None and asked == [False]
    again = find_tape("waits", tape.BUILD_FROM, lambda: pytest.fail("it is traced twice"))
    assert again is not None and again[0] is found[0] and asked == [False, True]


def test_without_a_library_a_long_list_is_left_to_array_code(monkeypatch) -> None:
    """NumPy calls a function for each operation, so that array code is quicker where they are many."""
    monkeypatch.setattr(tape, "_get_library", lambda build: None)
    monkeypatch.setattr(tape, "MAX_IN_NUMPY", 3)
    assert find_tape("long", tape.TRACE_FROM, build_tape) is None


def test_no_compiler_and_a_refusal_give_no_library(monkeypatch) -> None:
    """`TAU_DYN_COMPILE=0` keeps programs from compiling."""
    monkeypatch.setenv("TAU_DYN_COMPILE", "0")
    assert tape._get_library(True) is None
