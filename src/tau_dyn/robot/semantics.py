"""Contents of an SRDF beyond the robot file: the joints that no motor drives."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import ParseError

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring

from tau_dyn.exceptions import InputError
from tau_dyn.files import read_bytes

_MAX_BYTES = 8 * 2**20  # largest size of an SRDF; real ones have tens of kilobytes


def find_srdf(robot: Path) -> Path | None:
    """Return the SRDF next to a robot file: the one of the same name, or the only one in the folder."""
    beside = robot.with_name(f"{robot.name.split('.')[0]}.srdf")
    return beside if beside.is_file() else None


def read_passive_joints(path: Path) -> tuple[str, ...]:
    """Return the joints that an SRDF calls passive.

    Raises:
        InputError: The file does not exist, is not XML, or is not an SRDF.
    """
    try:
        root = fromstring(read_bytes(path, _MAX_BYTES), forbid_dtd=True)
    except OSError as fault:
        raise InputError("cannot_read", f"{path}: cannot be read ({fault.strerror})") from fault
    except DefusedXmlException as fault:
        raise InputError("file_format", f"{path}: an SRDF may not declare a document type or entities") from fault
    except ParseError as fault:
        raise InputError("file_format", f"{path}: not well-formed XML ({fault})") from fault
    if root.tag != "robot":
        raise InputError("file_format", f"{path}: the root element is <{root.tag}>, an SRDF's is <robot>")
    if root.find("link") is not None:
        raise InputError(
            "file_format", f"{path}: it holds links, as a robot file does; an SRDF names groups and passive joints"
        )
    return tuple(element.get("name", "") for element in root.findall("passive_joint"))
