"""A reader of the package: its valid files, its mutations, and what is done with what it read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from random import Random

from fuzz_parts import mutate_bytes, mutate_tables, mutate_trees, mutate_xml, seeds

Mutation = Callable[[bytes, Random], bytes]


@dataclass(frozen=True)
class Reader:
    """One reader.

    Attributes:
        name: What `--reader` calls it.
        suffix: Of its files.
        valid: Returns its valid files, given a folder to work in.
        mutations: What is done to them.
        read: Reads a file and uses what it read, as the commands do.
        weight: Share of the campaign's time, in parts.
        needs: Libraries of extras without which it only says which to install.
    """

    name: str
    suffix: str
    valid: Callable[[Path], Sequence[bytes]]
    mutations: Sequence[Mutation]
    read: Callable[[Path], object]
    weight: float = 1.0
    needs: tuple[str, ...] = ()

    def mutated(self, bases: Sequence[bytes], rng: Random) -> bytes:
        """Return a case: a file after one to four mutations."""
        data = rng.choice(bases)
        for _ in range(rng.choice((1, 1, 1, 2, 2, 4))):
            if rng.random() < 0.05:
                data = mutate_bytes.splice(data, rng.choice(bases), rng)
                continue
            try:
                data = rng.choice(self.mutations)(data, rng)
            except Exception:  # noqa: S112  a file so broken that the mutation's own library fails on it stays as it is
                continue
        return data[: mutate_bytes.LARGEST * 4]


def of(*files: bytes) -> Callable[[Path], list[bytes]]:
    """Return a function that gives these files, whatever the folder."""
    return lambda folder: list(files)


def by_name(module: str, function: str, *more: object) -> Callable[[Path], object]:
    """Return a reader that is imported when it is used."""

    def read(path: Path) -> object:
        from importlib import import_module

        return getattr(import_module(f"tau_dyn.{module}"), function)(path, *more)

    return read


def beside(folder: Path, name: str, made: Callable[[], bytes]) -> Path:
    """Return a good file that a reader needs beside the case; it is made where it is missing."""
    other = folder / name
    if not other.exists():
        other.write_bytes(made())
    return other


@cache
def pendulum():
    """Return the robot that most files are about: one joint, `axis`, that turns."""
    from tau_dyn.robot import load_robot_from_urdf

    return load_robot_from_urdf(seeds.PENDULUM, "pendulum.urdf")


@cache
def axis():
    """Return the model of the linear axis that comes with the package: one joint, `axis`, that slides."""
    from tau_dyn.model import Model
    from tau_dyn.robot import load_robot

    return Model.of(load_robot("linear_axis"))


BINARY = mutate_bytes.ANY
TABLE = mutate_tables.CSV * 2 + mutate_bytes.TEXT
PARQUET = mutate_tables.PARQUET * 3 + mutate_bytes.ANY
YAML = mutate_trees.YAML * 3 + mutate_bytes.TEXT
JSON = mutate_trees.JSON * 3 + mutate_bytes.TEXT
JOURNAL = (mutate_trees.json_lines,) * 6 + mutate_bytes.TEXT
XML = mutate_xml.XML * 3 + mutate_bytes.TEXT + mutate_xml.RARE
"""What is done to files of each kind: mostly changes of their structure, some of their bytes."""
