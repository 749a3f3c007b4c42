"""Links hold: files are there, headings are there, addresses elsewhere are well-formed."""

from __future__ import annotations

import re
import sys
import unicodedata
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from page_blocks import ROOT, all_pages

_CODE = re.compile(r"^( *)```.*?^\1```|`[^`\n]*`", re.M | re.S)
_LINK = re.compile(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)|(?:src|href)=\"([^\"]+)\"")
_HEADING = re.compile(r"^#{1,6} +(.+?) *#*$", re.M)
_NAMED = re.compile(r"(?:id|name)=\"([^\"]+)\"|\{#([\w-]+)")
PAGES = [str(path.relative_to(ROOT)) for path in all_pages()]


def links(page: str) -> list[str]:
    """Return every address that a page leads to, code left out."""
    return [a or b for a, b in _LINK.findall(_CODE.sub("", page))]


@cache
def anchors(path: Path) -> frozenset[str]:
    """Return what a page's headings are called in addresses, by mkdocs and by a source browser."""
    text = path.read_text(encoding="utf-8")
    found = {a or b for a, b in _NAMED.findall(text)}
    for heading in _HEADING.findall(re.sub(r"^( *)```.*?^\1```", "", text, flags=re.M | re.S)):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").replace("*", "")
        ascii_only = unicodedata.normalize("NFKD", plain).encode("ascii", "ignore").decode()
        kept = re.sub(r"[^\w\s-]", "", ascii_only).strip().lower()
        found |= {re.sub(r"[-\s]+", "-", kept), re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())}
    return frozenset(found)


def fault_of(link: str, page: Path) -> str:
    """Return what is wrong with a link, or nothing."""
    parts = urlsplit(link)
    if parts.scheme:
        good = parts.scheme in ("https", "http", "mailto") and (parts.netloc or parts.path) and " " not in link
        return "" if good else "no address"
    target = page if not parts.path else (page.parent / unquote(parts.path)).resolve()
    if not target.exists():
        return "no such file"
    if not target.is_relative_to(ROOT):
        return "leaves the project"
    if parts.fragment and target.suffix == ".md" and parts.fragment not in anchors(target):
        return "no such heading"
    return ""


@pytest.mark.parametrize("name", PAGES)
def test_links_of_a_page_hold(name):
    """No link of README, docs and experiments is dead."""
    page = ROOT / name
    faults = {link: fault_of(link, page) for link in links(page.read_text(encoding="utf-8"))}
    assert not {link: fault for link, fault in faults.items() if fault}


def test_a_dead_link_is_seen(tmp_path):
    """A file, a heading or an address that is not there is named; code is not taken for links."""
    page = ROOT / "README.md"
    text = "[a](docs/none.md) [b](docs/results/index.md#none) ![c](docs/report.png) `[d](nowhere)` [e](https:nowhere.x)"
    assert [fault_of(link, page) for link in links(text)][:3] == ["no such file", "no such heading", ""]
    assert len(links(text)) == 4
