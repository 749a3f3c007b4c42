"""A data set -> the same samples for every tool, in files: training data whole, held-out data without what is to be predicted.

Forces: positions are low-passed at 40 Hz and differentiated here; tools get q, v, a and the raw force. Predicted and measured
forces are then low-passed alike at 20 Hz and compared where a joint moves: faster than 5 % of its fast speed (the 95 % quantile
of the training data), 50 ms before and after too. At rest friction is any force up to its break-away, for every model. A quarter
of a second at each end is left out. Filters are zero-phase Butterworth of order 4; slow logs are filtered at a fifth and a tenth
of their rate. The mask is of the motion alone and is the same for all tools.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, sosfiltfilt

from comparison_parts.case import Case
from tau_dyn.log import Log, resample_segments

POSITION_HZ, FORCE_HZ, EDGE_S = 40.0, 20.0, 0.25
MIN_PIECE_S = 4 * EDGE_S
"""Shortest stretch without a gap that is used [s]: half of it is compared."""
SLOW_SHARE, FAST_QUANTILE, SURROUND_S = 0.05, 0.95, 0.05
Arrays = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Held:
    """A held-out stretch as the judge has it: time (N,), what is to be predicted (N, n), and which samples count (N, n)."""

    t: np.ndarray
    target: np.ndarray
    counts: np.ndarray


def smooth(x: np.ndarray, cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return columns (N, n) low-passed without phase."""
    return sosfiltfilt(butter(4, cutoff_hz, fs=rate_hz, output="sos"), x, axis=0)


def prepare_forces(log: Log, joints: tuple[str, ...]) -> list[Arrays]:
    """Return t (N,), q, v, a and tau (N, na) of each stretch without a gap, positions filtered and differentiated."""
    pieces = []
    for piece in resample_segments(log):
        if piece.t[-1] - piece.t[0] < MIN_PIECE_S:
            continue
        dt, rate = float(np.median(np.diff(piece.t))), piece.rate_hz
        q = smooth(piece.joint("q", joints), min(POSITION_HZ, rate / 5), rate)
        v = np.gradient(q, dt, axis=0)
        pieces.append(
            {"t": piece.t, "q": q, "v": v, "a": np.gradient(v, dt, axis=0), "tau": piece.joint("tau", joints)}
        )
    return pieces


def prepare(case: Case, logs: list[Log]) -> list[Arrays]:
    """Return what is known of logs (a dict a stretch), with `target` (N, n) what a tool is to predict."""
    if case.kind == "force":
        return [x | {"target": x["tau"]} for log in logs for x in prepare_forces(log, case.channels)]
    if case.kind == "servo":
        return [
            {"t": log.t, "cmd": log.joint("cmd", case.channels), "target": log.joint("q", case.channels),
             "start": log.joint("q", case.channels)[0], **{k: x for k, x in log.channels.items() if k in SERVO_SIGNALS}}
            for log in logs
        ]  # fmt: skip
    return [
        {"t": log.t, **{k: np.stack([log.channels[c] for c in names], axis=1)
                        for k, names in (("u", case.inputs), ("target", case.outputs))}}
        for log in logs
    ]  # fmt: skip


SERVO_SIGNALS = ("torque_enable", "input_volts")
"""What a servo's log holds beside commands and positions, given for held-out motions too."""
PREDICTED = ("target", "tau")


def get_stem(log: Log) -> str:
    """Return a log's name as a file's."""
    return re.sub(r"\W+", "_", re.sub(r"\.(csv|parquet)\b", "", log.name))


def strip_shapes(urdf: str) -> str:
    """Return a robot file without shapes, whose meshes are not at hand."""
    root = ElementTree.fromstring(urdf)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")


def find_counting(piece: Arrays, fast: np.ndarray) -> np.ndarray:
    """Return which samples of forces are compared (N, na)."""
    rate = (len(piece["t"]) - 1) / (piece["t"][-1] - piece["t"][0])
    slow = np.abs(piece["v"]) < SLOW_SHARE * fast
    near = 2 * round(SURROUND_S * rate) + 1
    counts = ~maximum_filter1d(slow.astype(np.uint8), near, axis=0).astype(bool)
    edge = round(EDGE_S * rate)
    counts[:edge] = counts[len(counts) - edge :] = False
    return counts


def write_samples(case: Case, folder: Path) -> list[Held]:
    """Write the files that tools read; return the held-out stretches with their targets, which tools do not read."""
    folder.mkdir(parents=True, exist_ok=True)
    about = {
        "name": case.name,
        "kind": case.kind,
        "channels": case.channels,
        "inputs": case.inputs,
        "order": case.order,
        "fixed": case.fixed,
    }
    if case.robot:
        (folder / "robot.urdf").write_text(strip_shapes(case.robot.urdf))
    if case.law:
        (folder / "law.yaml").write_text(case.law.read_text())
    (folder / "logs").mkdir()
    for log in case.train:
        log.to_csv(folder / "logs" / f"{get_stem(log)}.csv")
    train, held = prepare(case, case.train), prepare(case, case.held)
    for k, piece in enumerate(train):
        np.savez(folder / f"train_{k:02d}.npz", **piece)
    for k, piece in enumerate(held):
        np.savez(folder / f"held_{k:02d}.npz", **{key: x for key, x in piece.items() if key not in PREDICTED})
    about |= {"train_names": list(map(get_stem, case.train)), "held_names": list(map(get_stem, case.held))}
    (folder / "set.json").write_text(json.dumps(about, indent=1))
    if case.kind != "force":
        return [Held(x["t"], x["target"], np.ones(x["target"].shape, dtype=bool)) for x in held]
    fast = np.quantile(np.abs(np.concatenate([x["v"] for x in train])), FAST_QUANTILE, axis=0)
    return [Held(x["t"], x["target"], find_counting(x, fast)) for x in held]
