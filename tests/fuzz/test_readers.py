"""Whatever a file holds, its reader answers or refuses in one sentence; the long campaign is `experiments/fuzz.py`."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from random import Random

import pytest
import yaml
from hypothesis import HealthCheck, given, settings, strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from fuzz_parts.judge import judge
from fuzz_parts.readers import READERS, Reader

QUICK = settings(
    derandomize=True, database=None, deadline=None, max_examples=15, suppress_health_check=list(HealthCheck)
)
COMMANDS = settings(QUICK, max_examples=5)
"""A command takes ten times as long as a reader."""
YAML_READERS = [name for name, reader in READERS.items() if reader.suffix == ".yaml"]
SCALARS = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.dates(), st.binary(max_size=4),
    st.sampled_from(["axis", "asymmetric_friction", "q_axis", "tau_axis", "all", "t", math.inf, 10**30]),
)  # fmt: skip
KEYS = SCALARS.filter(lambda key: not isinstance(key, bytes))
TREES = st.recursive(SCALARS, lambda x: st.lists(x, max_size=4) | st.dictionaries(KEYS, x, max_size=4), max_leaves=12)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for cases."""
    return tmp_path_factory.mktemp("cases")


def _installed(name: str) -> Reader:
    for library in READERS[name].needs:
        pytest.importorskip(library)
    return READERS[name]


def _settings(name: str) -> settings:
    return COMMANDS if name.startswith("tau-dyn") else QUICK


@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_answered_or_refused(name: str, folder: Path) -> None:
    """Valid files after some mutations: no traceback, no silence, no hang."""
    reader = _installed(name)
    bases, path = list(reader.valid(folder)), folder / f"{name}{reader.suffix}"

    @_settings(name)
    @given(st.integers(0, 2**32))
    def case(number: int) -> None:
        path.write_bytes(reader.mutated(bases, Random(number)))
        verdict = judge(reader.read, path, 30.0)
        assert not verdict.fault, verdict

    case()


@pytest.mark.parametrize("name", READERS)
def test_valid_files_are_answered(name: str, folder: Path) -> None:
    """What is mutated is read in the first place; a reader that refuses everything would pass the other tests."""
    reader = _installed(name)
    for k, data in enumerate(reader.valid(folder)):
        path = folder / f"valid_{name}_{k}{reader.suffix}"
        path.write_bytes(data)
        assert judge(reader.read, path, 60.0).kind == "answer"


@pytest.mark.parametrize("name", YAML_READERS)
def test_any_yaml_under_any_key_is_answered_or_refused(name: str, folder: Path) -> None:
    """A valid file in which one entry holds any tree at all."""
    reader, path = _installed(name), folder / f"tree_{name}.yaml"
    valid = yaml.safe_load(reader.valid(folder)[0])

    @_settings(name)
    @given(st.sampled_from(sorted(valid)), TREES)
    def case(key: str, tree: object) -> None:
        path.write_text(yaml.safe_dump({**valid, key: tree}, sort_keys=False, allow_unicode=True), encoding="utf-8")
        verdict = judge(reader.read, path, 30.0)
        assert not verdict.fault, verdict

    case()
