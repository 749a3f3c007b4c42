"""A report page taken apart: what of it could run, load or reach out, and is not ours."""

from __future__ import annotations

import re
from html.parser import HTMLParser

_INERT = {"application/json"}
_REACHING = {
    "img",
    "iframe",
    "object",
    "embed",
    "link",
    "base",
    "form",
    "input",
    "audio",
    "video",
    "foreignobject",
    "frame",
    "applet",
}
_LINKS = {"src", "href", "xlink:href", "action", "formaction", "data", "srcdoc", "poster", "background"}


class Suspect(HTMLParser):
    """Collects what does not belong on a page of ours.

    Attributes:
        found: Sentences.
        scripts: Texts of the scripts that would run.
        data: Texts of the scripts that hold data only.
    """

    def __init__(self) -> None:
        """Begin with nothing found."""
        super().__init__(convert_charrefs=True)
        self.found: list[str] = []
        self.scripts: list[str] = []
        self.data: list[str] = []
        self._into: list[str] | None = None

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Look at a tag and its attributes."""
        given = dict(attrs)
        self._into = None
        if tag == "script":
            self._into = self.data if given.get("type") in _INERT else self.scripts
            self._into.append("")
        if tag in _REACHING:
            self.found.append(f"<{tag}>")
        if (
            tag == "meta"
            and (given.get("http-equiv") or "content-security-policy").lower() != "content-security-policy"
        ):
            self.found.append(f"<meta {attrs}>")
        for name, value in attrs:
            if name.startswith("on") or (name in _LINKS and not (value or "").startswith("#")):
                self.found.append(f"<{tag} {name}={value!r}>")
            if name == "style" and re.search(r"url\(|expression|@import|</", value or ""):
                self.found.append(f"<{tag} style={value!r}>")

    handle_startendtag = handle_starttag

    def handle_endtag(self, tag: str) -> None:
        """Leave a script."""
        self._into = None

    def handle_data(self, data: str) -> None:
        """Keep a script's text."""
        if self._into is not None:
            self._into[-1] += data


def taken_apart(page: str) -> Suspect:
    """Return what a browser would find in a page."""
    suspect = Suspect()
    suspect.feed(page)
    suspect.close()
    return suspect
