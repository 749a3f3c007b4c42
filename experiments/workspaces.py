"""How large are the robots' workspaces, and does L1's look like the thesis' Figures 2.4, 5.22 and 5.23?

    python experiments/workspaces.py [--out DIR] [--quick]

Writes `workspaces.csv` (every robot at its default resolution), `l1_figures.csv` (L1 against the thesis), a page a robot.
The thesis says: a cross-section of about 1 m x 1 m at 40 degrees (Figure 2.4); grid of 10 cm, ball joints 30 degrees,
carts +-1 m (Figure 5.22); of that 0.4 left by obstacles and 10 cm of border (Figure 5.23). The obstacles are known from a
picture alone, so boxes of about their size stand in: the share that the border alone leaves is told apart.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.exceptions import TauDynError
from tau_dyn.kinematics.obstacles import build_surroundings
from tau_dyn.kinematics.workspace import PoseRequirements, find_workspace, study_workspace
from tau_dyn.render import build_page
from tau_dyn.robot import load_robot

ROBOTS = {
    "l1": ("gantry_tau", {"prototype": "l1"}),
    "l2": ("gantry_tau", {"prototype": "l2"}),
    "d1": ("gantry_tau", {"prototype": "d1"}),
    "t1": ("gantry_tau", {"prototype": "t1"}),
    "f1": ("gantry_tau_f1", {}),
    "t2": ("gantry_tau_t2", {}),
    "stewart": ("stewart", {}),
    "delta": ("delta", {}),
    "triglide": ("triglide", {}),
    "hexaglide": ("hexaglide", {}),
}
LAB = {  # m, assumed: about what Figure 5.23 shows
    "obstacles": [
        {"name": "table", "box": {"centre": [1.1, -1.2, 0.1], "size": [0.9, 0.7, 0.8]}, "blocks": "tool"},
        {"name": "IRB 2400", "box": {"centre": [2.6, 0.2, 0.6], "size": [0.6, 0.8, 1.6]}, "blocks": "tool"},
        {"name": "equipment behind", "box": {"centre": [0.6, -0.3, 0.6], "size": [0.5, 1.6, 1.6]}, "blocks": "tool"},
        {"name": "palette", "box": {"centre": [2.5, -1.3, -0.1], "size": [0.8, 0.8, 0.6]}, "blocks": "tool"},
    ]
}


def main(out: Path, quick: bool) -> None:
    out.mkdir(parents=True, exist_ok=True)
    figures = l1_figures()
    figures.to_csv(out / "l1_figures.csv", index=False)
    print(figures.to_string(index=False))
    rows = [row_of(name, out, quick) for name in (["l1", "stewart"] if quick else ROBOTS)]
    table = pd.DataFrame(rows)
    table.to_csv(out / "workspaces.csv", index=False)
    print(table.to_string(index=False))


def l1_figures() -> pd.DataFrame:
    robot, rows = load_robot("gantry_tau"), []
    for angle in (None, 40.0):
        asked = PoseRequirements(ball_angle=np.pi if angle is None else np.deg2rad(angle), collisions=False)
        found = study_workspace(robot, demands=asked, sections=["x=1.75"], resolution=0.04)
        cut = found.sections[0]
        u, v = cut.u[cut.inside.any(axis=1)], cut.v[cut.inside.any(axis=0)]
        words = "Figure 2.4, inverse kinematics alone" if angle is None else "Figure 2.4, ball joints 40 degrees"
        rows.append(
            (words, "width x height [m]", f"{np.ptp(u):.2f} x {np.ptp(v):.2f}", "" if angle is None else "about 1 x 1")
        )
        rows.append((words, "area [m^2]", f"{cut.area:.2f}", ""))
    ball = np.deg2rad(30.0)
    kinematic = find_workspace(robot, resolution=0.1, demands=PoseRequirements(ball_angle=ball, collisions=False))
    fine = find_workspace(robot, resolution=0.02, demands=PoseRequirements(ball_angle=ball, collisions=False))
    border = find_workspace(
        robot, resolution=0.02, demands=PoseRequirements(ball_angle=ball, collisions=False, border=0.1)
    )
    lab = PoseRequirements(ball_angle=ball, collisions=False, border=0.1, surroundings=build_surroundings(LAB, "lab"))
    rest = find_workspace(robot, resolution=0.02, demands=lab)
    sides = " x ".join(f"{x:.2f}" for x in fine.upper - fine.lower)
    rows += [
        ("Figure 5.22, ball joints 30 degrees", "points of a 10 cm grid", f"{int(kinematic.inside.sum())}", ""),
        (
            "Figure 5.22, ball joints 30 degrees",
            "volume [m^3]",
            f"{fine.size.value:.3f} ({fine.size.low:.3f} to {fine.size.high:.3f})",
            "",
        ),
        ("Figure 5.22, ball joints 30 degrees", "box [m]", sides, ""),
        ("Figure 5.23, 10 cm from the border", "share left", f"{border.size.value / fine.size.value:.2f}", ""),
        (
            "Figure 5.23, with obstacles (assumed boxes)",
            "share left",
            f"{rest.size.value / fine.size.value:.2f}",
            "0.4",
        ),
    ]
    return pd.DataFrame(rows, columns=["figure", "what", "ours", "thesis"])


def row_of(name: str, out: Path, quick: bool) -> dict[str, object]:
    short, arguments = ROBOTS[name]
    start = time.process_time()
    try:
        found = study_workspace(load_robot(short, **arguments))
    except TauDynError as fault:
        return {"robot": name, "fault": str(fault)}
    space, rows = found.workspace, found.catalogue.rows
    spent = time.process_time() - start
    if not quick:
        (out / f"{name}.html").write_text(build_page(found), encoding="utf-8")
    return {
        "robot": name,
        "volume_m3": round(space.size.value, 5),
        "low": round(space.size.low, 5),
        "high": round(space.size.high, 5),
        "per_footprint_m": round(space.size.value / space.footprint.area, 3) if space.footprint.area else None,
        "per_installation": round(space.size.value / space.footprint.area / space.footprint.height, 3)
        if space.footprint.area * space.footprint.height
        else None,
        "condition_median": round(rows["condition"].spread.median, 2),
        "tilt_every_way_deg": round(float(np.rad2deg(found.tilt.angle.min())), 0) if found.tilt else None,
        "step_m": space.lattice.step,
        "cpu_s": round(spent, 1),
        "fault": "",
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/workspaces"))
    parser.add_argument("--quick", action="store_true", help="L1 and the hexapod alone, no pages")
    args = parser.parse_args()
    main(args.out, args.quick)
