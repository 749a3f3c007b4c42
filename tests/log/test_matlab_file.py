"""MATLAB files bit by bit: what is a signal becomes a column, all else is passed over, and wrong sizes are damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from raising import raises_code
from scipy.io import savemat

from tau_dyn.log import read_log
from tau_dyn.log.lab_files.matlab import read_variables
from tau_dyn.log.topic_columns import LONGEST_LIST

N = 40
T = np.arange(N) * 0.01


def saved(folder: Path, **variables) -> Path:
    savemat(folder / "run.mat", variables)
    return folder / "run.mat"


@pytest.mark.parametrize("kind", ["f8", "f4", "i1", "u2", "i4", "u8"])
def test_numbers_keep_their_values_and_dimensions(tmp_path, kind: str):
    """MATLAB stores columns first; every kind of real number comes back as it was."""
    x = np.arange(6).reshape(2, 3).astype(kind)
    assert_array_equal(read_variables(saved(tmp_path, x=x))["x"], x)


def test_what_is_no_real_number_is_passed_over(tmp_path):
    """Complex numbers and text have no value here, and do not stop the real ones beside them."""
    found = read_variables(saved(tmp_path, z=np.exp(1j * T), word="hello", x=T))
    assert found["z"] is None and found["word"] is None
    assert_allclose(found["x"], [T])


@pytest.mark.parametrize("said", [N - 1, N + 1])
def test_dimensions_that_do_not_fit_the_numbers_are_damage(tmp_path, said: int):
    """A matrix of 40 numbers that calls itself 1 by 39 or 1 by 41 was changed on the way."""
    path = saved(tmp_path, x=T)
    data = path.read_bytes()
    assert data.count(struct.pack("<2i", 1, N)) == 1
    path.write_bytes(data.replace(struct.pack("<2i", 1, N), struct.pack("<2i", 1, said)))
    with raises_code("damaged_file", str(N), str(said)):
        read_variables(path)


def test_structs_in_a_row_are_told_by_their_places(tmp_path):
    """A cell of structs is as many signals, up to a number that no robot has axes for."""
    cells = np.empty(3, object)
    cells[:] = [{"values": k * T} for k in range(3)]
    log = read_log(saved(tmp_path, t=T, q_axis=T, axes=cells))
    for k in range(3):
        assert_allclose(log.channels[f"axes[{k}].values"], k * T)
    for count, read in ((LONGEST_LIST, LONGEST_LIST), (LONGEST_LIST + 1, 0)):
        many = np.empty(count, object)
        many[:] = [{"values": T}] * count
        channels = read_log(saved(tmp_path, t=T, q_axis=T, axes=many)).channels
        assert sum(name.startswith("axes") for name in channels) == read


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_that_breaks_off_inside_any_variable_says_so(tmp_path, compressed: bool):
    """Cut after each eighth byte: between variables those before are read, inside one nothing is guessed."""
    rng = np.random.default_rng(0)
    path = tmp_path / "run.mat"
    savemat(path, {"t": T, "q_axis": rng.random(N), "tau_axis": rng.random(N)}, do_compression=compressed)
    data, at, ends = path.read_bytes(), 128, [128]
    while at < len(data):
        at += 8 + struct.unpack_from("<I", data, at + 4)[0]
        ends.append(at)
    assert len(ends) == 4 and ends[-1] == len(data)
    for cut in range(128, len(data), 8):
        path.write_bytes(data[:cut])
        whole = [k for k, end in enumerate(ends) if cut - 8 < end <= cut]
        if whole:
            assert list(read_variables(path)) == ["t", "q_axis", "tau_axis"][: whole[0]]
        else:
            with raises_code("damaged_file", "run.mat"):
                read_variables(path)
