"""Every reader of the package, by name, and the commands that read."""

from __future__ import annotations

from fuzz_parts.commands import COMMANDS
from fuzz_parts.read_logs import LOGS
from fuzz_parts.read_results import RESULTS
from fuzz_parts.read_robots import ROBOTS
from fuzz_parts.reader import Reader

READERS: dict[str, Reader] = {reader.name: reader for reader in (*LOGS, *ROBOTS, *RESULTS, *COMMANDS)}
"""All readers by name."""
