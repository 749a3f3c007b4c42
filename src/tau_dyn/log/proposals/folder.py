"""Propose a column map for a folder: one recording with a file per topic, or recordings with the same columns.

Files with the same columns are recordings of their own, and the map of the first is proposed. Files with different columns are
taken for one recording; each file's columns are proposed as those of a log, and the map names the files (`column_map.py`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tau_dyn.exceptions import CannotAnswer, InputError
from tau_dyn.files import compute_joint_sha256
from tau_dyn.log.check import JointLimits
from tau_dyn.log.column_map import ColumnMap
from tau_dyn.log.column_names import format_names
from tau_dyn.log.proposals.columns import ColumnProposal, propose_log_columns, read_columns
from tau_dyn.log.read import has_topics, read_log
from tau_dyn.log.table import PARQUET_SUFFIXES
from tau_dyn.message_codes import CodedWarning

LOG_SUFFIXES = (".csv", ".tsv", ".txt", ".dat", *PARQUET_SUFFIXES)
"""Suffixes of the files of a folder that are read as logs."""


def propose_columns(path: str | Path, robot: JointLimits) -> ColumnProposal:
    """Propose a column map for a log of a robot.

    Args:
        path: The log, in any format that `read_log` reads, or a folder of text or Parquet files.
        robot: Its actuated joints with their kinds and limits.

    Raises:
        InputError: The log cannot be read, or the files of a folder do not belong together.
        CannotAnswer: No column except the clock holds numbers; no file of a folder has positions.
    """
    path = Path(path)
    if path.is_dir() and not has_topics(path):
        return _propose_folder_columns(path, robot)
    return propose_log_columns(path, robot)


def _propose_folder_columns(folder: Path, robot: JointLimits) -> ColumnProposal:
    """Return the map of a folder's text and Parquet files; other files are ignored."""
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in LOG_SUFFIXES and p.is_file())
    if not paths:
        raise InputError(
            "file_not_found", f"{folder} is a folder without CSV or Parquet files; give the path of a log."
        )
    columns = {path: tuple(read_columns(path).cells) for path in paths}
    if len(set(columns.values())) > 1:
        return _join_files(folder, columns, robot)
    proposal = propose_log_columns(paths[0], robot)
    sentence = (
        f"The {len(paths)} files of {folder.name} have the same columns and are taken for recordings of their own; the map "
        f"is that of {paths[0].name}, and each command takes the files, not the folder."
    )
    warnings = (CodedWarning("column_unsure", sentence), *proposal.warnings) if len(paths) > 1 else proposal.warnings
    return replace(proposal, warnings=warnings)


def _join_files(folder: Path, columns: Mapping[Path, Sequence[str]], robot: JointLimits) -> ColumnProposal:
    """Return the map of one recording with a file per topic."""
    proposals = {path: propose_log_columns(path, robot, is_part=True) for path in columns}
    useful = {path: p for path, p in proposals.items() if set(p.entries) - {"t"}}
    main = next((path for path, p in useful.items() if any(key.startswith("q_") for key in p.entries)), None)
    if main is None:
        found = "; ".join(f"{path.name}: {format_names(names)}" for path, names in columns.items())
        raise CannotAnswer(
            "positions_missing",
            f"no file of {folder} has columns that can be the positions of {format_names(robot.actuated)} ({found})",
            "name the files and columns in a column map, as `files: {pos: FILE}` and "
            f"`q_{robot.actuated[0]}: {{file: pos, column: COLUMN}}`",
        )
    _refuse_twins(folder, useful)
    keys = {path: _name_key(path, k) for k, path in enumerate(useful)}
    entries: dict[str, Any] = {"files": {keys[path]: _describe_file(path, useful[path], main) for path in useful}}
    entries |= {"t": _take_from(useful[main].entries["t"], keys[main])} if "t" in useful[main].entries else {}
    for path, proposal in useful.items():
        entries |= {key: _take_from(value, keys[path]) for key, value in proposal.entries.items() if key != "t"}
    sentence = (
        f"The files of {folder.name} have different columns and are taken for one recording; give the folder, or one of its "
        "files, with this map."
    )
    warnings = [CodedWarning("column_unsure", sentence)]
    warnings += [warning for proposal in useful.values() for warning in proposal.warnings]
    if missing := [joint for joint in robot.actuated if f"tau_{joint}" not in entries]:
        left = [f"{path.name}: {format_names(names)}" for path, names in columns.items()]
        sentence = (
            f"No column is the torque of {format_names(missing)} ({'; '.join(left)}); name it in the map, or log it."
        )
        warnings.append(CodedWarning("column_missing", sentence))
    try:
        read_log(folder, ColumnMap.from_dict(entries))
    except InputError as fault:
        warnings.append(CodedWarning("column_unsure", f"Read by this map, the folder is refused: {fault}"))
    digest = compute_joint_sha256(p.sha256 for p in useful.values())
    return ColumnProposal(folder.name, digest, tuple(robot.actuated), entries, tuple(dict.fromkeys(warnings)))


def _refuse_twins(folder: Path, proposals: Mapping[Path, ColumnProposal]) -> None:
    """Refuse files that hold the same quantity: the folder holds several recordings."""
    owner: dict[str, Path] = {}
    for path, proposal in proposals.items():
        for key in proposal.entries:
            if key != "t" and (other := owner.setdefault(key, path)) != path:
                raise InputError(
                    "mismatch",
                    f"{folder}: {other.name} and {path.name} both have {key}; put the files of one recording into a folder "
                    "of its own, or give one file.",
                )


def _name_key(path: Path, k: int) -> str:
    """Return a file's key in the map: its name without odd characters, or its number where another could have the same."""
    word = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    return word if word == path.stem and not word[0].isdigit() else f"file_{k + 1}"


def _describe_file(path: Path, proposal: ColumnProposal, main: Path) -> Any:
    """Return a file's entry under `files`: its name, and its clock unless it is the main file."""
    clock = proposal.entries.get("t")
    return path.name if path == main or clock is None else {"path": path.name, "t": clock}


def _take_from(value: Any, key: str) -> Any:
    """Return a column's entry with its file."""
    if isinstance(value, dict) and "rate_hz" in value:
        return value
    return {"file": key, **(value if isinstance(value, dict) else {"column": value})}
