"""The site is whole: every page is in its navigation, and what is generated is current."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT

OF_THE_SITE = {"tutorials/first_hour.md"}  # joins from experiments/ while the site is built


class _Plain(yaml.SafeLoader):
    """YAML in which mkdocs' own tags are words."""


_Plain.add_multi_constructor("tag:yaml.org,2002:python/name:", lambda loader, suffix, node: suffix)


def _named(item: object) -> list[str]:
    if isinstance(item, str):
        return [item]
    return [name for part in (item.values() if isinstance(item, dict) else item) for name in _named(part)]  # type: ignore[union-attr]


def test_every_page_is_in_the_navigation():
    """A page that nobody can find might as well not be there; a line without a page is dead."""
    config = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), _Plain)  # noqa: S506 (a safe loader)
    listed = _named(config["nav"])
    there = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
    assert len(listed) == len(set(listed))
    assert set(listed) - OF_THE_SITE == there


def test_the_site_fetches_nothing():
    """No font, script or style comes from elsewhere."""
    config = yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), _Plain)  # noqa: S506
    assert config["theme"]["font"] is False
    styles = [(ROOT / "docs" / path).read_text(encoding="utf-8") for path in config["extra_css"]]
    assert not re.findall(r"https?://", "".join(styles) + str(config.get("extra_javascript", "")))


def test_the_page_of_commands_is_what_the_parsers_say():
    """Where it differs, run `python experiments/commands_page.py` again."""
    spec = importlib.util.spec_from_file_location("commands_page", ROOT / "experiments" / "commands_page.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8") == module.page()


def _is_room(origin: str, name: str) -> bool:
    beside = Path(origin).parent / name
    return beside.is_dir() or beside.with_suffix(".py").is_file()


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "reference" / "python").glob("*.md")), ids=lambda p: p.stem)
def test_a_page_of_a_room_names_a_room(page):
    """A page of the Python reference is about a package that says what it holds; no public name is a file's beside it."""
    text = page.read_text(encoding="utf-8")
    (name,) = re.findall(r"^::: tau_dyn\.(\w+)$", text, re.M)
    spec = importlib.util.find_spec(f"tau_dyn.{name}")
    assert name == page.stem and spec is not None and spec.origin is not None
    if spec.submodule_search_locations:
        stub = Path(spec.origin).with_suffix(".pyi").read_text(encoding="utf-8")
        public = re.findall(r" as (\w+)", stub)
        assert public and not [x for x in public if _is_room(spec.origin, x)]
