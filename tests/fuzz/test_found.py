"""What fuzzing found, one case each; every one was a traceback, a hang or worse, and is a sentence now."""

from __future__ import annotations

import io
import itertools
import json
import re
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from numpy.testing import assert_allclose
from raising import raises_code

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from fuzz_parts import seed_motions, seeds
from fuzz_parts.judge import judge
from fuzz_parts.readers import READERS

from tau_dyn.exceptions import CannotAnswer
from tau_dyn.log import read_log
from tau_dyn.log.copies import copy_groups
from tau_dyn.mechanism import convert_from_quaternions
from tau_dyn.modes import Record
from tau_dyn.modes.delay import InitialModels, choose_delay
from tau_dyn.modes.methods import estimate_first_poles
from tau_dyn.modes.record import build_records


def parquet(**columns: object) -> bytes:
    """Return a Parquet file with twenty rows of a clock and these columns."""
    out = io.BytesIO()
    pq.write_table(pa.table({"t": [k * 0.1 for k in range(20)], **columns}), out)
    return out.getvalue()


def csv(header: str, cell: str = "0") -> bytes:
    """Return a log of twenty rows in which one cell is odd."""
    rows = [f"{k / 10},{cell if k == 3 else k % 5},0" for k in range(20)]
    return "\n".join([header, *rows]).encode()


LOG = "t,q_axis,tau_axis"
NOT_UTF8 = parquet(q_axis=[0.0] * 20).replace(b"q_axis", b"q_\xe0xis")
DEEP_CHAIN = seeds.PENDULUM.replace(
    "</robot>", "".join(f'<link name="k{k}_link"/>' for k in range(3000)) + "</robot>"
).encode()


def chain(n: int) -> bytes:
    """Return a robot on whose tool hangs a chain of so many joints that move."""
    names = ["tool", *(f"k{k}_link" for k in range(n))]
    joint = """<link name="{1}"/><joint name="of_{1}" type="revolute"><parent link="{0}"/><child link="{1}"/><axis xyz="0 0 1"/>
      <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""
    rows = [joint.format(*pair) for pair in itertools.pairwise(names)]
    return seeds.PENDULUM.replace("</robot>", "".join(rows) + "</robot>").encode()


with TemporaryDirectory() as made:
    MODEL = seeds.model_file(Path(made))
    COMPENSATION = seeds.compensation_file(Path(made))
    CALIBRATED = seeds.calibrated(Path(made))
FOUND = {
    "a header cell beyond the csv module's 128 KiB": ("csv", csv("t,q_axis," + "x" * 140_000)),
    "a quoted cell beyond 128 KiB": ("csv", csv(LOG, '"' + "x" * 140_000 + '"')),
    "a header of 200000 names": ("csv", csv(",".join(f"c{k}" for k in range(200_000)))),
    "a whole number of 400 digits": ("csv", csv(LOG, "9" * 400)),
    "a name of kilobytes in the message": ("csv", csv("t," + "x" * 50_000 + "," + "x" * 50_000)),
    "a Parquet name that is no UTF-8": ("parquet", NOT_UTF8),
    "a Parquet date beyond Python's": ("parquet", parquet(q_axis=pa.array([10**8] * 20, pa.int32()).cast(pa.date32()))),
    "a Parquet time beyond nanoseconds": ("parquet", parquet(q_axis=pa.array([10**15] * 20, pa.timestamp("s")))),
    "sixty-based numbers of any length": ("camera", b"camera: 1:" + b"1:" * 600 + b"1.5\n"),
    "an empty whole number": ("controller", b"position_gain: !!int ''\n"),
    "a date that is none": ("tracker", b"tracker: !!timestamp soon\n"),
    "a truth that is none": ("errors", b"actuators: !!bool maybe\n"),
    "20000 open brackets": ("errors", b"actuators: " + b"[" * 20_000),
    "aliases of 10^9 entries": ("surroundings", b"a: &a [x, x, x, x, x, x, x, x, x]\n" + b"".join(
        b"%c: &%c [%s]\n" % (98 + k, 98 + k, b", ".join([b"*%c" % (97 + k)] * 9)) for k in range(9))),
    "a map of thousands of equal keys": ("column_map", b"q_axis: a\n" * 4_000),
    "limits of whole numbers that no float holds": ("surroundings", b"limits: {x: [-1%s, 1%s]}\n" % (b"0" * 400, b"0" * 400)),
    "a coordinate axis called nothing": ("surroundings", b"limits: {null: [0, 1]}\n"),
    "a part of a camera called nothing": ("camera", seeds.CAMERA + b"null: 1\n"),
    "inputs that are no list": ("state_space", seeds.STATE_SPACE.replace(b"inputs: [u]", b"inputs: true")),
    "a matrix of a truth": ("state_space", seeds.STATE_SPACE.replace(b"A: [[0.9, 0.1], [-0.1, 0.9]]", b"A: true")),
    "a provenance that is a list": ("state_space", seeds.STATE_SPACE.replace(b"{logs: []}", b"[1, 2]")),
    "a lens that is a list": ("cameras", seeds.CAMERAS.replace(b"lens: brown", b"lens: []")),
    "joints that are no names": ("progress", json.dumps({**seeds.PROGRESS, "actuated": [True]}).encode()),
    "a motion of thousands of years": ("motion", b"t,q_ref_axis\n" + b"".join(b"%d,0.1\n" % (k * 10**10) for k in range(20))),
    "a robot of 3000 links": ("urdf", DEEP_CHAIN),
    "a compensation of a list of kinds": ("compensation", COMPENSATION.replace(b"kind: tree", b"kind: [tree]")),
    "a calibrated robot whose orientation is a number": (
        "calibrated_robot", re.sub(rb"quaternion:\n( +- .*\n){4}", b"quaternion: 1.0\n", CALIBRATED, count=1)),
    "a clock with a key that is a number": ("column_map", b"t: {rate_hz: 100, 1.5: 2}\nq_axis: position\n"),
    "couplings of a key that is a number": ("column_map", seeds.COLUMN_MAP.replace(b"q_offset: [0.0]", b"1.5: [0.0]")),
    "a journal whose item is a tree": ("journal", b'{"about": {}}\n{"item": {"a": 1}, "result": 1}\n'),
    "a journal a thousand levels deep": ("journal", b"[" * 100_000 + b"\n"),
    "a calibrated robot whose backlash is none": (
        "calibrated_robot", CALIBRATED.replace(b"backlash:\n- 0.0", b"backlash:\n- .nan")),
    "a calibrated robot whose device is nowhere": ("calibrated_robot", CALIBRATED.replace(
        b"frames:\n  device:\n  - translation:\n    - ", b"frames:\n  device:\n  - translation:\n    - .nan\n    - ")),
    "a model whose actuated joint is a number": ("model", re.sub(rb"actuated:\n +- axis", b"actuated: [1.5]", MODEL)),
    "an effect on no joint": ("tau-dyn simulate --effects", b"effects: [{effect: cyclic_ripple, joints: []}]\n"),
    "a label among the settings": (
        "effects", b"effects: [{effect: stribeck, settings: {speed: 0.02, label: a}, label: a}]\n"),
    "joints among the settings": ("effects", b"effects: [{effect: stribeck, settings: {joints: [axis]}}]\n"),
    "an effect of two thousand million terms": ("model", MODEL.replace(b"harmonics: 1\n", b"harmonics: 2147483648\n")),
    "a chain of 900 joints": ("urdf", chain(900)),
    "a cloud of 175000 columns of few names": ("cloud", b",".join([b"c1", b"c2"] * 87_500) + b"\n"),
    "a cloud of 40000 columns below a quoted line end": ("cloud", b'"x\n",' + b",".join([b"c1", b"c2"] * 20_000) + b"\n1,2\n"),
    "a calibrated robot without frames": (
        "calibrated_robot", re.sub(rb"(?s)frames:.*?noise:", b"frames: {device: [], tool: []}\nnoise:", CALIBRATED)),
    "points of a path that are text": ("path_points", seed_motions.way().replace(b"0.1,", b"~,")),
    "points of a path beyond the universe": ("path_points", seed_motions.way().replace(b"0.1,", b"1e308,")),
    "a table of a xacro with 20000 open brackets": ("xacro_table", b"x: " + b"[" * 20_000),
    "a table of a xacro with a sixty-based number": ("xacro_table", b"x: 1:" + b"1:" * 600 + b"1.5\n"),
    "a bag's file of a name too long": (
        "bag2_metadata", yaml.dump({"rosbag2_bagfile_information": {"relative_file_paths": ["x" * 300]}}).encode()),
    "a cloud of giant whole numbers": ("cloud", b"x,y,z\n" + b"1%s,1,1\n" % (b"0" * 400) + b"0,0,0\n"),
    "a workspace in a box without an end": ("view_computed", json.dumps(
        {"command": "workspace", "status": "ok", "inputs": [], "warnings": [], "resolution_m": 1e-7,
         "size": {"name": "area", "value": 1.0, "unit": "m2", "low": 0.9, "high": 1.1},
         "bounding_box": {"lower": [-0.5, 0, 0], "upper": [0.5, 0, float("nan")]}}).encode()),
    "elements 20000 deep": ("xacro", seeds.XACRO.replace("</robot>", "<a>" * 20_000 + "</a>" * 20_000 + "</robot>").encode()),
}  # fmt: skip


@pytest.mark.parametrize("case", FOUND)
def test_what_was_found_is_refused_in_a_sentence(case: str, tmp_path: Path) -> None:
    """The file that broke the reader, or the smallest like it."""
    name, data = FOUND[case]
    path = tmp_path / f"case{READERS[name].suffix}"
    path.write_bytes(data)
    verdict = judge(READERS[name].read, path, 5.0)
    assert verdict.kind == "refused", verdict


def test_uneven_steps_and_numbers_near_the_largest_are_read(tmp_path: Path) -> None:
    """The spline of a foreign column had slopes beyond a float; found in a MATLAB file."""
    t = [k * 0.01 + 0.003 * (k % 2) for k in range(40)]
    rows = "".join(f"{x},{x},{x},{1e308 * (-1) ** k}\n" for k, x in enumerate(t))
    (tmp_path / "log.csv").write_text("t,q_axis,tau_axis,other\n" + rows)
    assert judge(READERS["csv"].read, tmp_path / "log.csv", 5.0).kind == "answer"


def test_poses_of_as_many_campaigns_as_poses_are_read_in_linear_time(tmp_path: Path) -> None:
    """Each name was looked up in a list."""
    path = tmp_path / "poses.csv"
    rows = "".join(f"0,0,0,1,c{k}\n" for k in range(60_000))
    path.write_text("q_axis,x_tool,y_tool,z_tool,campaign\n" + rows)
    assert judge(READERS["calibration_poses"].read, path, 5.0).kind == "answer"


def test_a_result_with_numbers_beyond_a_float_is_refused(tmp_path: Path) -> None:
    """JSON has whole numbers of any length."""
    path = tmp_path / "r.json"
    row = {"name": "a", "value": 10**400, "unit": ""}
    path.write_text(json.dumps({**seeds.IDENTIFY, "parameters": [row]}))
    assert judge(READERS["result"].read, path, 5.0).kind == "refused"


def test_standard_errors_near_the_largest_number_are_shown(tmp_path: Path) -> None:
    """The terminal asked for ten to the power of 309 to learn how many decimals such an error has."""
    path = tmp_path / "r.json"
    row = {"name": "a.mass", "value": 1.0, "unit": "kg", "stderr": 1e308, "ci95": [0, 2], "identifiable": True}
    path.write_text(json.dumps({**seeds.IDENTIFY, "parameters": [row]}))
    assert judge(READERS["tau-dyn compare"].read, path, 20.0).kind == "answer"


def test_a_damaged_row_group_that_is_copied_is_refused(tmp_path: Path) -> None:
    """Parquet too large to be read at once is copied in pieces; a dictionary that lacks an entry shows only then."""

    class Damaged:
        schema_arrow = pa.schema({"t": pa.float64()})

        def iter_batches(self, batch_size: int):
            yield pa.record_batch({"t": [0.0] * batch_size})
            raise pa.ArrowInvalid("Index not in dictionary bounds")

    with raises_code("damaged_file", "log.parquet"):
        copy_groups("log.parquet", [(tmp_path / "log.parquet", cast(pq.ParquetFile, Damaged()))], 16)


def test_a_chain_of_hundreds_of_joints_is_read_soon(tmp_path: Path) -> None:
    """The axis of each joint was asked of preparations for the whole chain: a second a joint."""
    (tmp_path / "r.urdf").write_bytes(chain(160))
    begun = time.process_time()
    assert judge(READERS["urdf"].read, tmp_path / "r.urdf", 5.0).kind == "answer"
    assert time.process_time() - begun < 10.0


def test_a_link_without_mass_whose_inertia_is_negative_is_refused_as_one_with_mass_is(tmp_path: Path) -> None:
    """Pinocchio builds no such inertia where the mass is nothing, and said so in a traceback."""
    for mass in (b"0", b"2"):
        (tmp_path / "r.urdf").write_bytes(
            seeds.PENDULUM.encode()
            .replace(b'<origin xyz="0 0 -0.5" rpy="0 0 0"/><mass value="2"/>', b'<mass value="%s"/>' % mass)
            .replace(b'izz="0.01"', b'izz="-2.5"')
        )
        assert judge(READERS["urdf"].read, tmp_path / "r.urdf", 5.0).kind == "refused"


def test_delays_without_a_model_are_tried_once(tmp_path: Path) -> None:
    """A vibration log of giant numbers gave no model at some delays, and `modes` tried those again for ever."""
    (tmp_path / "log.csv").write_bytes(seed_motions.shaken())
    records, asked = build_records(read_log(tmp_path / "log.csv"), ["tau_axis"], ["q_axis"]), Counter[int]()

    def first(some: Sequence[Record], delay: int) -> InitialModels:
        asked[delay] += 1
        assert asked[delay] == 1, f"delay {delay} was tried before"
        if delay in (1, 2):
            raise CannotAnswer("no_solution", "no model follows", "a longer log")
        return estimate_first_poles("n4sid", some, delay=delay)

    assert choose_delay(records, first, orders=(2,), most=4).delay in (0, 3, 4)
    assert {1, 2} <= asked.keys()


def test_a_quaternion_whose_square_is_beyond_a_float_has_a_direction() -> None:
    """1e308 overflowed on the way to the quaternion's length; it points where 1 does."""
    poses = convert_from_quaternions(np.zeros((2, 3)), np.array([[-1e308, 0, 0, 0], [-1, 0, 0, 0]]))
    assert_allclose(poses.rotation[0], poses.rotation[1], atol=1e-15)


def test_pictures_that_do_not_tell_the_patterns_pose_are_refused(tmp_path: Path) -> None:
    """Pixels noisier than the picture is wide led the pattern's pose to where all corners fall together."""
    text = seeds.CAMERA.replace(b"0.8], look", b"-1.191312826514406e-09], look").replace(
        b"0.2}", b"1263.7822947078432}"
    )
    (tmp_path / "camera.yaml").write_bytes(text)
    verdict = judge(READERS["tau-dyn plan-poses --camera"].read, tmp_path / "camera.yaml", 60.0)
    assert verdict.kind == "refused", verdict
