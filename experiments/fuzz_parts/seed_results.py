"""Valid results of the commands whose answer the viewer shows, written by hand; and one that its data could not give."""

from __future__ import annotations

import hashlib
from pathlib import Path

from fuzz_parts import seeds

_OK = {"status": "ok", "inputs": [], "warnings": []}
_SIZE = {"name": "area", "value": 1.0, "unit": "m2", "low": 0.9, "high": 1.1}
WORKSPACE = {
    "command": "workspace",
    **_OK,
    "size": _SIZE,
    "bounding_box": {"lower": [-0.5, 0.0, 0.5], "upper": [0.5, 0.0, 1.5]},
    "resolution_m": 0.25,
}
ACCURACY = {
    "command": "accuracy",
    **_OK,
    "methods": {"linear": {"max": 1e-4, "worst_pose": {"tool": [0.1, 0.0, 0.9]}}},
    "map": {"u": [0.0, 0.1, 0.2], "v": [0.5, 0.6], "linear": [[1e-4, 2e-4, None], [1e-4, 1e-4, 1e-4]]},
    "section": {"axis": "y", "value": 0.0},
}
CALIBRATE = {
    "command": "calibrate",
    **_OK,
    "findings": [],
    "errors_at_poses": {"points": [[0, 0, 1], [0.1, 0, 1]], "models": {"rods": [[1e-4, 0, 0], [0, 1e-4, 0]]}},
}
_SHAPE = {"x_tool": {"re": 1.0, "im": 0.0}, "z_tool": {"re": 0.1, "im": 0.2}}
MODES = {
    "command": "modes",
    **_OK,
    "outputs_used": ["x_tool", "z_tool"],
    "modes": [{"frequency_hz": 12.0, "damping_ratio": 0.02, "shape": _SHAPE}],
}
TO_SHOW = (
    {**WORKSPACE, "cloud": {"points": [[0, 0, 1], [0.1, 0, 1]], "values": {"condition number": [1.0, 2.0]}}},
    WORKSPACE,
    ACCURACY,
    {**ACCURACY, "map": None},
    CALIBRATE,
    MODES,
    seeds.IDENTIFY,
)
REFUSED = {
    "command": "identify",
    "status": "cannot_answer",
    "missing": "the motion is too dull",
    "experiment": "move faster",
    "inputs": [{"path": "a.csv", "sha256": "00"}],
}
"""A result that says what its data lacked; only in a run folder there is something to compare."""


def to_compute(folder: Path) -> list[bytes]:
    """Return results that lack what `--compute` works out: points of a workspace, errors at measured poses."""
    poses = seeds.csv_of(seeds.poses())
    (folder / "measured.csv").write_bytes(poses)
    given = {"path": str(folder / "measured.csv"), "sha256": hashlib.sha256(poses).hexdigest()}
    without = {k: v for k, v in CALIBRATE.items() if k != "errors_at_poses"}
    return seeds.as_json(WORKSPACE, {**without, "inputs": [given]})
