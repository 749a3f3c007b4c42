"""What mkdocs does with our pages beyond Markdown: equations become MathML, pages of other folders join, links to code work.

- `$..$` and `$$..$$` are turned into MathML while the site is built, so that no script and no font is fetched.
- `experiments/first_hour.md` becomes a page of the site.
- Each tutorial is a notebook as well, linked below its title.
- Links that leave docs/ for a file of the repository (`../identification/emps.py`) would be dead on the site: there they are
  shown as text with the path.
"""

from __future__ import annotations

import html
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
from notebook import build_notebook

ROOT = Path(__file__).resolve().parents[2]
JOINED = {"experiments/first_hour.md": "tutorials/first_hour.md"}
"""Page of the repository -> page of the site."""

_MATH = re.compile(r'<(?P<tag>span|div) class="arithmatex">(?P<tex>.*?)</(?P=tag)>', re.S)
_LINK = re.compile(r"(?<!!)\[(?P<text>[^\]]*)\]\((?P<to>[^)\s#:]+)(?P<anchor>#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Let pages from outside docs/ join."""
    for source, name in JOINED.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    for page in [f for f in files.documentation_pages() if _is_tutorial(f.src_uri)]:
        name = page.src_uri.removesuffix(".md") + ".ipynb"
        files.append(File.generated(config, name, content=build_notebook(page.content_string)))
    return files


def _is_tutorial(name: str) -> bool:
    return name.startswith("tutorials/") and name.endswith(".md") and name != "tutorials/index.md"


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Turn links so that they hold on the site."""
    name = page.file.src_uri
    here = next((source for source, joined in JOINED.items() if joined == name), f"docs/{name}")

    def turned(m: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(posixpath.dirname(here), m["to"]))
        target = JOINED.get(path, path.removeprefix("docs/"))
        if path in JOINED or (path.startswith("docs/") and files.get_file_from_path(target)):
            relative = posixpath.relpath(target, posixpath.dirname(name) or ".")
            return f"[{m['text']}]({relative}{m['anchor'] or ''})"
        if (ROOT / path).exists():
            return m["text"] if m["text"].strip("`") == path else f"{m['text']} (`{path}`)"
        return m[0]

    parts = re.split(r"(^```.*?^```|`[^`\n]+`)", markdown, flags=re.M | re.S)
    text = "".join(part if k % 2 else _LINK.sub(turned, part) for k, part in enumerate(parts))
    if _is_tutorial(name):
        link = f"[As a notebook]({posixpath.basename(name).removesuffix('.md')}.ipynb)"
        text = re.sub(r"\A(# .*\n)", rf"\1\n{link}\n", text)
    return text


def on_page_content(content: str, page: Any, config: Any, files: Files) -> str:
    """Put MathML in place of TeX."""
    return _MATH.sub(lambda m: _mathml(m["tex"], m["tag"] == "div", page.file.src_uri), content)


def _mathml(tex: str, display: bool, where: str) -> str:
    inner = html.unescape(tex.strip())[2:-2]  # without \( \) or \[ \]
    made = convert(inner, display="block" if display else "inline")
    if "\\" in made:  # a command that the converter does not know stays as it is
        raise PluginError(f"{where}: no MathML can be made of {inner!r}")
    return made
