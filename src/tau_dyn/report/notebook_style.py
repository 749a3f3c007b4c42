"""The style of drawings in a notebook: the page's own rules, scoped to a face, in the notebook's light or dark theme.

Only rules that begin with a class of a drawing are taken, so that nothing of a face reaches the notebook around it.
"""

from __future__ import annotations

import re
from functools import cache
from importlib.resources import files

DARK = ('body[data-jp-theme-light="false"]', "body.vscode-dark", 'html[theme="dark"]', '[data-theme="dark"]')
"""How JupyterLab, VS Code, Colab and documentation say that they are dark."""
_DRAWN = re.compile(
    r"\.(?:chart|bar|bar-[a-z]+|grid|zero|meter|robot|rail|rod|plate|cart|joint-name|triad|triad-name)(?![\w-])"
)
_RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")


@cache
def get_style(templates: tuple[str, ...] = ()) -> str:
    """Return the style of a face with the drawings of these templates, such as `modes_style`."""
    page = _asset("page.css")
    light, dark = (
        re.sub(r"color-scheme:[^;]*;", "", text).strip() for text in re.findall(r":root \{(.*?)\}", page, re.DOTALL)
    )
    own = [
        f".tau-dyn {{ {light} }}",
        f"{', '.join(f'{s} .tau-dyn' for s in DARK)} {{ {dark} }}",
        _asset("notebook.css"),
    ]
    sources = [page, *(_style_in(_asset(f"{name}.html.j2")) for name in templates)]
    return "\n".join([*own, *(rule for text in sources for rule in _scoped(text))])


def _style_in(template: str) -> str:
    """Return what a page's own style elements say."""
    return "\n".join(re.findall(r"<style>(.*?)</style>", template, re.DOTALL))


def _scoped(text: str) -> list[str]:
    """Return the rules of drawings, each selector below a face; those for printing are left out."""
    text = re.sub(r"\{%.*?%\}|\{\{.*?\}\}", "", text.split("@media print")[0])
    found = []
    for selectors, body in _RULE.findall(text):
        parts = [s.strip() for s in selectors.split(",")]
        if all(_DRAWN.match(part) for part in parts):
            found.append(f"{', '.join(f'.tau-dyn {part}' for part in parts)} {{{body}}}")
    return found


def _asset(name: str) -> str:
    return files("tau_dyn.report").joinpath("templates", name).read_text(encoding="utf-8")
