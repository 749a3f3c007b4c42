"""A picture of the viewer's window, from headless Chromium.

    python experiments/draw_viewer.py OUT.png [--seek T] [--cut Y] ... -- ROBOT [LOG] [options of tau-dyn view]

The pictures of docs/how_to/viewer.md (each command on one line):

    tau-dyn demo --out demo; tau-dyn diagnose gantry_tau demo/monday.csv --holdout demo/tuesday.csv --json why.json
    draw_viewer.py docs/figures/viewer_finding.png --seek 4 --enlarged 1000 --finding 2 -- gantry_tau
        demo/monday.csv --result why.json
    draw_viewer.py docs/figures/viewer_workspace.png --cut -0.7 -- gantry_tau --set arms=complete
        --compute --result workspace.json
    draw_viewer.py docs/figures/viewer_errors.png -- gantry_tau --compute --result calibration.json
    draw_viewer.py docs/figures/viewer_modes.png -- gantry_tau --set arms=complete --set flexible=true
        --set wrist=serial2 --result modes.json

Needs the extra `view`, Pillow and a Chromium on the path.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from chromium import Page

from tau_dyn.cli import view
from tau_dyn.files import write_atomically

WIDTH, HEIGHT = 1280, 800
_TOAST = "document.querySelectorAll('[class*=Notification-root]').forEach(e => e.remove())"
_LOADED = "document.querySelectorAll('[role=slider]').length > 0"


def settle(page: Page, seconds: float) -> None:
    """Wait until the page is there and its first picture has faded in."""
    if not page.wait_for(_LOADED):
        raise SystemExit("the page did not load")
    page.wait(seconds)
    page.evaluate(_TOAST)
    page.wait(2.0)


def shrink(source: Path, to: Path) -> None:
    """Write a picture with at most 256 colours."""
    from PIL import Image

    image = Image.open(source).convert("RGB").quantize(256)
    with write_atomically(to) as temporary:
        image.save(temporary, "PNG", optimize=True)


def main() -> None:
    """Take one picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seek", type=float, help="time of the log [s]")
    parser.add_argument("--enlarged", choices=("1", "10", "100", "1000"), help="of the ghost's distance")
    parser.add_argument("--cut", type=float, help="of a cloud, at y [m]")
    parser.add_argument("--finding", type=int, help="number of the one chosen")
    parser.add_argument("--wait", type=float, default=20.0, help="for the page to fade in [s]")
    words = [*sys.argv[1:], "--"]
    given, rest = parser.parse_args(words[: words.index("--")]), words[words.index("--") + 1 : -1]
    told = argparse.ArgumentParser()
    view.add(told)
    args = told.parse_args(rest)
    viewer = view.open_window(args, lambda step: None)
    if given.enlarged:
        viewer.player._enlarged.value = given.enlarged
    if given.seek is not None:
        viewer.player.seek(given.seek)
    for shown in viewer.panels:
        if given.cut is not None and getattr(shown, "_cut", None) is not None:
            shown._cut.value = given.cut
        if hasattr(shown, "swing"):
            shown._speed.value = 0.0
        if given.finding is not None and hasattr(shown, "choose"):
            shown._choice.value = list(shown._rows)[given.finding - 1]
    page = Page(viewer.url, WIDTH, HEIGHT, patience=180)
    try:
        settle(page, given.wait)
        with tempfile.TemporaryDirectory() as folder:
            page.picture(Path(folder) / "page.png")
            shrink(Path(folder) / "page.png", given.out)
        print(f"{given.out}: {given.out.stat().st_size // 1024} kB; errors: {page.errors()}")
    finally:
        page.close()
        viewer.close()


if __name__ == "__main__":
    main()
