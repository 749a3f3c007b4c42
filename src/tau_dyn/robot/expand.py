"""Expand a robot file to plain URDF text: short names, xacro arguments, MJCF, and XML that cannot expand entities.

A xacro file is code: it evaluates Python expressions. Here they have no access to Python itself (`xacro_evaluation.py`), and
neither the file nor anything it includes may declare a document type or entities. A xacro may still read files and run without
end. Load one only from people whose scripts you would run, or refuse all of them with `xacro=False`. A file that neither ends
in `.xacro` nor declares xacro's namespace is never evaluated.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any
from xml.dom.minidom import Document
from xml.parsers.expat import ExpatError

from defusedxml.common import DefusedXmlException
from defusedxml.expatbuilder import parseString  # like minidom's, without its network modules

from tau_dyn.exceptions import InputError, UnknownName, require_kind
from tau_dyn.files import format_yaml, read_bytes
from tau_dyn.robot.dimensions import TableChanges, read_number
from tau_dyn.robot.mjcf import convert_mjcf
from tau_dyn.robot.numbers import check_depth, check_names
from tau_dyn.robot.packages import find_described_robot, find_package, list_stock_robots
from tau_dyn.robot.xacro_evaluation import evaluate_xacro

_LOG = "; this looks like a log; were robot and log exchanged?"
_MODEL = "; is it a model file? A robot file is needed here"
_SWAPPED = {
    ".csv": _LOG,
    ".parquet": _LOG,
    ".mcap": _LOG,
    ".bag": _LOG,
    ".mat": _LOG,
    ".unv": _LOG,
    ".yaml": _MODEL,
    ".yml": _MODEL,
}
"""Hint for a file of another kind that was given as a robot."""

MAX_ROBOT_BYTES = 32 * 2**20
"""Largest size of a robot file [bytes]; real ones, without their meshes, have less than one MiB."""


def find_urdf_folder() -> Path:
    """Return the folder of the robots that come with the package."""
    installed = Path(str(files("tau_dyn"))) / "urdf"
    return installed if installed.is_dir() else Path(__file__).resolve().parents[3] / "urdf"


def list_robot_names() -> dict[str, Path]:
    """Return the robots that come with the package: short name -> file."""
    return {path.name.split(".")[0]: path for path in sorted(find_urdf_folder().glob("*.urdf*"))}


def list_robots() -> dict[str, Path]:
    """Return every robot that a name may mean: name -> file.

    Example:
        >>> td.list_robots()["gantry_tau"].name
        'gantry_tau.urdf.xacro'
    """
    return {
        **list_robot_names(),
        **{n: p for n, p in sorted(list_stock_robots().items()) if n not in list_robot_names()},
    }


def describe_robot(path: Path) -> str:
    """Return the first sentence of the first comment in a robot file, with its brackets closed; empty if it has no comment."""
    head = path.read_text(encoding="utf-8", errors="replace")[:4000]
    comment = re.search(r"<!--(.*?)-->", head, re.DOTALL)
    words = " ".join(comment.group(1).split()) if comment and path in list_robot_names().values() else ""
    whole = re.match(r"(?:\([^()]*\)|[^:;.(]|[:;.](?! |$))*", words)
    return whole.group().rstrip() if whole else words


def find_robot(robot: str | Path) -> Path:
    """Return the file that a path or a short name means.

    Raises:
        InputError: It is neither, or the file does not exist or is not a robot file.
        UnknownName: A bare word is not the name of a robot.
    """
    require_kind(robot, str | Path, "robot", "a Robot, a robot file's path or a name")
    path, stock = Path(robot), list_stock_robots()
    try:
        there = path.is_file()
    except OSError as fault:
        raise InputError("file_not_found", f"{path}: no such robot file ({fault.strerror})") from fault
    if there:
        if not path.name.endswith((".urdf", ".urdf.xacro", ".xacro", ".xml", ".mjcf")):
            raise InputError(
                "file_format",
                f"{path}: a robot file ends in .urdf or .urdf.xacro, or is MJCF in .xml{_SWAPPED.get(path.suffix.lower(), '')}",
            )
        return path
    if (path.suffix or len(path.parts) > 1) and str(robot) not in stock:
        _refuse_folder(path)
        raise InputError(
            "file_not_found",
            f"{path}: no such robot file; give a .urdf or .urdf.xacro that exists, or a short name such as gantry_tau",
        )
    ours = list_robot_names()
    if str(robot) in ours:
        return ours[str(robot)]
    if str(robot) in stock:
        return stock[str(robot)]
    if described := find_described_robot(str(robot)):
        return described.path
    _refuse_folder(path)
    if str(robot).endswith("_description"):
        raise InputError(
            "file_not_found",
            f"{robot}: robot_descriptions has it not in its cache; `python -m robot_descriptions pull {robot}` puts it there",
        )
    more = "" if stock else "; `pip install example-robot-data` adds stock arms such as ur5"
    raise UnknownName("robot", str(robot), [*ours, *stock], more=more)


def _refuse_folder(path: Path) -> None:
    if path.name and path.is_dir():
        raise InputError(
            "cannot_read", f"{path} is a folder; give the robot file in it, or a short name such as gantry_tau"
        )


def expand(
    path: Path,
    arguments: Mapping[str, object] | None = None,
    *,
    evaluate: bool = True,
    packages: Mapping[str, str | Path] | None = None,
) -> str:
    """Expand a robot file to URDF text.

    Args:
        path: A `.urdf`, `.urdf.xacro` or MJCF file.
        arguments: xacro arguments by name, and entries of the tables that the xacro loads (`dimensions.py`).
        evaluate: Whether a xacro may be evaluated; a plain URDF never is.
        packages: Folders of ROS packages by name.

    Raises:
        InputError: The file is not well-formed, declares entities, is a xacro that may not be evaluated, or cannot be expanded.
        UnknownName: An argument that the file does not declare.
    """
    given = {name: str(value) for name, value in (arguments or {}).items()}
    if evaluate and not packages and path in list_robot_names().values():
        written = tuple((str(p), p.stat().st_mtime_ns) for p in sorted(path.parent.rglob("*")) if p.is_file())
        return _expand_own(path, tuple(given.items()), written)
    return _expand(path, given, evaluate, packages=packages)[0]


@lru_cache(maxsize=32)
def _expand_own(path: Path, given: tuple[tuple[str, str], ...], written: tuple[tuple[str, int], ...]) -> str:
    """Expand a built-in robot once; it is expanded again only if a file in its folder changes."""
    del written  # part of the cache key
    return _expand(path, dict(given), evaluate=True)[0]


def list_dimensions(
    path: Path, arguments: Mapping[str, object] | None = None, *, evaluate: bool = True
) -> dict[str, str]:
    """Return the names for `--set` of a xacro: its arguments with their values, then the entries of the tables that it loads.

    Raises:
        InputError: As `expand`.
    """
    given = {name: str(value) for name, value in (arguments or {}).items()}
    _, declared, changes = _expand(path, given, evaluate, listing=True)
    return {name: given.get(name, default) for name, default in declared.items()} | changes.numbers


def _expand(
    path: Path,
    given: dict[str, str],
    evaluate: bool,
    listing: bool = False,
    packages: Mapping[str, str | Path] | None = None,
) -> tuple[str, dict[str, str], TableChanges]:
    """Return the URDF text, the arguments that the file declares with their defaults, and its tables."""
    changes = TableChanges({})

    def read_table(name: str) -> str:
        """Return a table that a xacro loads, with changes to it, after a check that it does not take long to load."""
        try:
            return changes.apply(format_yaml(name), str(name))
        except InputError as fault:
            changes.fault = fault  # xacro wraps it in another message
            raise

    def find(name: str) -> str:
        """Return the folder of a ROS package that a xacro requests."""
        try:
            return str(find_package(name, path, packages))
        except InputError as fault:
            changes.fault = fault
            raise

    try:
        document = _parse(None, str(path))
        declared = _list_arguments(document)
        own = {name: value for name, value in given.items() if name in declared}
        more = {name: value for name, value in given.items() if name not in declared}
        changes = TableChanges(more, listing=listing)
        _check_arguments(path, declared, own)
        if is_xacro(path, document):
            if not evaluate:
                raise InputError(
                    "unsupported",
                    f"{path} is a xacro, which is code, and no code may run; expand it to plain URDF first",
                )
            evaluate_xacro(document, path, own, _parse, read_table, find)
            check_depth(document, str(path))
        changes.require_all_used(list(declared), str(path))
        check_names(document.getElementsByTagName("*"), str(path))
        if document.documentElement is not None and document.documentElement.tagName == "mujoco":
            return convert_mjcf(document.toxml(), path), declared, changes
        _rename_twins(document)
        return document.toprettyxml(indent="  "), declared, changes
    except InputError as fault:
        raise fault if str(fault).startswith(str(path)) else InputError(fault.code, f"{path}: {fault}") from fault
    except (RecursionError, MemoryError) as fault:
        raise InputError("file_format", f"{path}: expands without end") from fault
    except Exception as fault:  # any exception of an expression in the file: an error of the file, reported below
        if changes.fault is not None:
            raise changes.fault from fault
        reason = " ".join(str(fault).split()) or type(fault).__name__
        reason = reason.partition(" when evaluating expression 'xacro.fatal(")[0]
        if given and "math domain error" in reason:
            reason = f"the dimensions do not fit together, such as rods too short to reach ({reason})"
        raise InputError("file_format", f"{path}: xacro cannot expand it: {reason}") from fault


def _rename_twins(document: Document) -> None:
    """Rename links that have the name of a joint: parameters are named after both."""
    root: Any = document.documentElement
    inside = [node for node in root.childNodes if node.nodeType == node.ELEMENT_NODE]
    names = {tag: {node.getAttribute("name") for node in inside if node.tagName == tag} for tag in ("link", "joint")}
    twins = {name: f"{name}_link" for name in sorted(names["link"] & names["joint"]) if name}
    if not twins or set(twins.values()) & (names["link"] | names["joint"]):
        return  # missing, or rejected when the robot is built
    for node in [node for parent in inside for node in (parent, *parent.getElementsByTagName("*"))]:
        keys = ("name",) if node.tagName == "link" or "body_" in node.tagName else ("link",)
        for key in keys:
            if node.getAttribute(key) in twins:
                node.setAttribute(key, twins[node.getAttribute(key)])
    said = document.createElement("tau_dyn:warning")
    root.setAttribute("xmlns:tau_dyn", "urn:tau_dyn")
    listed = ", ".join(f"'{name}' {new}" for name, new in twins.items())
    said.setAttribute("text", f"names of both a link and a joint; the links are called: {listed}")
    root.appendChild(said)


def is_xacro(path: Path, document: Document) -> bool:
    """Return whether a robot file is to be evaluated: by its name, or by xacro's namespace on its root."""
    root: Any = document.documentElement
    return path.name.endswith(".xacro") or root.hasAttribute("xmlns:xacro") or root.tagName.startswith("xacro:")


def _list_arguments(document: Document) -> dict[str, str]:
    """Return the declared arguments with their defaults."""
    tags = document.getElementsByTagName("xacro:arg")
    return {tag.getAttribute("name"): tag.getAttribute("default") for tag in tags}


def _check_arguments(path: Path, declared: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Reject a text in place of a built-in robot's number, and a negative number in place of a positive one."""
    if path not in list_robot_names().values():
        return
    for name, text in given.items():
        try:
            default = float(declared[name])
        except ValueError:
            continue
        if read_number(text, f"{path}: {name}") < 0 < default:
            raise InputError("invalid_value", f"{path}: {name} is not below zero, and {text} is")


def _parse(inp: object, filename: str | None = None) -> Document:
    """Parse like `xacro.parse`, but without entities, and with file and line of an error."""
    if isinstance(inp, Document):
        return inp
    name = filename or "robot text"
    try:
        text = read_bytes(str(filename), MAX_ROBOT_BYTES) if inp is None else str(inp).encode()
        document = parseString(text, forbid_dtd=True)  # type: ignore[arg-type]
        check_depth(document, name)
        return document
    except OSError as fault:
        raise InputError("cannot_read", f"{name}: cannot be read ({fault.strerror})") from fault
    except DefusedXmlException as fault:
        raise InputError("file_format", f"{name}: a robot file may not declare a document type or entities") from fault
    except ExpatError as fault:
        hint = _prefix_hint(str(fault))
        raise InputError("file_format", f"{name}, line {fault.lineno}: not well-formed XML ({fault}){hint}") from fault


def _prefix_hint(message: str) -> str:
    return "; declare xmlns:xacro and xmlns:drake on <robot>" if "unbound prefix" in message else ""
