"""The window in a real browser: it loads, moves both ways, keeps to itself, and runs nothing that a file brings along.

Skipped where there is no Chromium.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "experiments"))
from chromium import Page, find_chromium

from tau_dyn.robot import load_robot
from tau_dyn.view import Viewer
from tau_dyn.view.results import Cloud, Findings, ViewedFinding

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no chromium on the path")
BAD = "<img src=x onerror='window.ran=1'><script>window.ran=1</script>{window.ran=1}"
RIGHT = {"key": "ArrowRight", "code": "ArrowRight", "windowsVirtualKeyCode": 39}


@pytest.fixture(scope="module")
def viewer():
    """A window with a finding and a cloud whose names are hostile."""
    made = Viewer(load_robot("gantry_tau"), port=18500, shadows=False)
    made.add([Findings(BAD, (ViewedFinding(BAD, BAD, ("cart2", BAD)),))])
    points = np.random.default_rng(0).uniform(0, 1, (20, 3))
    made.add([Cloud(BAD, points, {BAD: points[:, 0]}, BAD)])
    yield made
    made.close()


@pytest.fixture(scope="module")
def page(viewer):
    """The page, once the robot's sliders are there."""
    opened = Page(viewer.url, 480, 360)
    assert opened.wait_for("document.querySelectorAll('[role=slider]').length >= 3")
    yield opened
    opened.close()


def test_it_loads_and_shows_the_robot(page, viewer):
    """Name and joints stand in the panel, a canvas is drawn, and one client is connected."""
    assert page.wait_for("document.body.innerText.includes('cart3 [m]')")
    assert "gantry_tau" in page.evaluate("document.title + document.body.innerText")
    assert page.evaluate("document.querySelectorAll('canvas').length") >= 1
    assert len(viewer.server.get_clients()) == 1


def test_the_page_moves_the_robot_and_the_robot_the_page(page, viewer):
    """A key on the first slider moves cart 1 by a thousandth of its travel; positions set here stand in the page."""
    before = viewer.q.copy()
    page.evaluate("document.querySelector('[role=slider]').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", **RIGHT)
    page.call("Input.dispatchKeyEvent", type="keyUp", **RIGHT)
    end = time.monotonic() + 20
    while np.array_equal(viewer.q, before) and time.monotonic() < end:
        page.wait(0.05)
    step = (viewer.robot.upper[0] - viewer.robot.lower[0]) / 1000
    assert abs(viewer.q[0] - before[0] - step) < 0.6 * step and np.allclose(viewer.q[1:], before[1:])
    viewer.show(viewer.robot.home + np.array([0.25, 0.0, 0.0]))
    wanted = round(float(viewer.q[0]), 2)
    now = "Number(document.querySelector('[role=slider]').getAttribute('aria-valuenow'))"
    assert page.wait_for(f"Math.abs({now} - {wanted}) < 0.01")


def test_nothing_from_a_file_runs_and_nothing_leaves(page):
    """Hostile names are text on the page; every request stays on this computer; the console knows no error."""
    assert page.wait_for("document.body.innerText.includes('<img src=x')")
    assert page.evaluate("window.ran === undefined")
    assert page.evaluate("document.querySelectorAll('img[src=x]').length") == 0
    away = [u for u in page.requests() if not u.startswith(("http://127.0.0.1:", "data:", "blob:"))]
    assert not away
    assert not page.errors()
