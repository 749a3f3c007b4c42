"""Do the error maps of section 4.3 of Dressler 2012 come out on the D1, and how good is the method of its Appendix A?

    python experiments/thesis_4_3.py [OUT_DIR] [--grid 41] [--samples 500] [--seed 43]

In: nothing; the D1's calibrated dimensions (Table 5.8) and the errors of Table 4.2. Out, in OUT_DIR (default out/thesis_4_3):
Figures 4.8, 4.9 and 4.10 as PNG and SVG, `maps.csv` with every method at every point, `summary.csv` with our numbers beside the
thesis' printed ones, and where first-order bounds fail: `enlarged.csv` (all errors times a factor) and `singular.csv` (towards a
singularity). The summary is printed. Needs matplotlib (`pip install tau_dyn[experiments]`). About 1 minute on one core.

What the thesis leaves open: the cut's x, the area's edges, the calibration state of the dimensions it used and the dashed line of
Figure 4.8. The cut does not matter (guideways parallel to 0.5 mrad). The area is taken to end at the guideways on the left
and above (the figure's "framework, left and upper edge") and at the reach elsewhere, limits of joints unknown. The dashed
line is taken from guideway 3, lower left, to guideway 2, upper right.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from tau_dyn.kinematics.accuracy import (
    ActuatorError,
    ErrorBounds,
    Section,
    build_device,
    build_isotropic_error,
    compute_positioning_errors,
    lay_grid,
    scale_errors,
    study_accuracy,
)
from tau_dyn.mechanism import Poses, build_rods, forward_kinematics, inverse_kinematics
from tau_dyn.robot import load_robot

CASES = {  # Table 4.2
    "case 1": ErrorBounds({f"cart{i}": build_isotropic_error(r) for i, r in ((1, 32e-6), (2, 77e-6), (3, 54e-6))}),
    "case 2": ErrorBounds({
        "cart1": ActuatorError(axes=(11e-6, 28e-6, 28e-6)),
        "cart2": ActuatorError(axes=(58e-6, 38e-6, 38e-6)),
        "cart3": ActuatorError(axes=(19e-6, 47e-6, 47e-6)),
    }),
}  # fmt: skip
THESIS = {"case 1": (140.0, 230.0), "case 2": (90.0, 170.0)}  # um, section 4.3
AREAS = ("within framework", "all within reach")
METHODS = ("linear", "parallelepiped", "ellipsoid", "exact", "certified", "montecarlo")


def main(out_dir: Path, grid: int, samples: int, seed: int) -> None:
    robot = load_robot("gantry_tau", prototype="d1")
    rods = build_rods(robot)
    home = forward_kinematics(rods, robot.home[None]).poses
    out_dir.mkdir(parents=True, exist_ok=True)
    rows, maps, found = [], [], {}
    every = lay_grid(rods, Section(0, 0.0), grid, limits=False)
    left, above = guideways(rods)[:, 1].min(), guideways(rods)[:, 2].max()
    framed = (left, every.u[-1]), (every.v[0], above)
    for area, across in zip(AREAS, (framed, None), strict=True):
        cut = lay_grid(rods, Section(0, 0.0, across), grid, limits=False)
        tool = cut.poses.take(cut.ok)
        for case, errors in CASES.items():
            result = study_accuracy(rods, errors, cut.q[cut.ok], tool, grid=cut, samples=samples, seed=seed)
            found[area, case] = result
            rows += summary(area, case, result)
            maps.append(pd.DataFrame({"area": area, "case": case, "y": tool.position[:, 1], "z": tool.position[:, 2]}
                                     | result.accuracy.largest))  # fmt: skip
    table = pd.DataFrame(rows)
    line = faces(robot, rods, CASES["case 1"])
    table = pd.concat([table, pd.DataFrame(claims(rods, found, line))], ignore_index=True)
    table.to_csv(out_dir / "summary.csv", index=False, float_format="%.4g")
    pd.concat(maps).to_csv(out_dir / "maps.csv", index=False, float_format="%.6g")
    line.to_csv(out_dir / "figure_4_9.csv", index=False, float_format="%.6g")
    enlarged(robot, rods, home).to_csv(out_dir / "enlarged.csv", index=False, float_format="%.5g")
    singular(robot, rods).to_csv(out_dir / "singular.csv", index=False, float_format="%.5g")
    draw(out_dir, rods, found, line)
    print(table.to_string(index=False, float_format="{:.4g}".format, na_rep=""))
    for name in ("enlarged", "singular"):
        print(
            f"\n{name}\n"
            + pd.read_csv(out_dir / f"{name}.csv").to_string(index=False, float_format="{:.4g}".format, na_rep="none")
        )


def guideways(rods, x: float = 0.0) -> np.ndarray:
    """Return where the guideways pierce the cut (3, 3) [m]."""
    home = rods.robot.home[None]
    A, v = rods.base_points(home)[0], np.einsum("kck->kc", rods.base_jacobian(home)[0])
    return A + v * ((x - A[:, 0]) / v[:, 0])[:, None]


def summary(area: str, case: str, result) -> list[dict]:
    """Return each method's range over the area in um, beside the thesis' for the method it used."""
    a, rows = result.accuracy, []
    for method in METHODS:
        s, off = result.summary(method), 100 * a.off(method)
        printed = THESIS[case] if method == "ellipsoid" and area == "within framework" else (np.nan, np.nan)
        rows.append({"area": area, "case": case, "what": method, "least": 1e6 * s.least, "median": 1e6 * s.median,
                     "largest": 1e6 * s.most, "thesis from": printed[0], "thesis to": printed[1],
                     "off from": np.nanmin(off), "off to": np.nanmax(off)})  # fmt: skip
    return rows


def claims(rods, found: dict, line: pd.DataFrame) -> list[dict]:
    """Return the thesis' other sentences as numbers: the saddle, the corners, the largest face."""
    rows, pierced = [], guideways(rods)
    for case in CASES:
        a = found["within framework", case].accuracy
        size, at = 1e6 * a.largest["ellipsoid"], a.position[:, 1:]
        named = {"middle": (-4.3, 0.0), "at guideway 1, upper left": pierced[0, 1:],
                 "at guideway 2, upper right": pierced[1, 1:],
                 "at guideway 3, lower left": pierced[2, 1:], "lower right": (-3.3, -0.9)}  # fmt: skip
        corner = {k: size[np.argmin(np.linalg.norm(at - p, axis=1))] for k, p in named.items()}
        rows += [
            {"area": "within framework", "case": case, "what": f"ellipsoid, {k}", "median": v}
            for k, v in corner.items()
        ]
    share = {
        k: float((line[f"face {k}"] >= line[[f"face {i}" for i in (1, 2, 3)]].max(axis=1)).mean()) for k in (1, 2, 3)
    }
    rows += [
        {"case": "case 1", "what": f"Figure 4.9: face {k} largest, share of the line", "median": v}
        for k, v in share.items()
    ]
    return rows


def faces(robot, rods, errors: ErrorBounds) -> pd.DataFrame:
    """Return the areas of the parallelepiped's faces from guideway 3 to guideway 2 (Figure 4.9)."""
    (_, (_, y1, z1), (_, y0, z0)) = guideways(rods)
    share = np.linspace(0.02, 0.96, 60)
    position = np.column_stack([0 * share, y0 + share * (y1 - y0), z0 + share * (z1 - z0)])
    tool = Poses(position, np.broadcast_to(forward_kinematics(rods, robot.home[None]).poses.rotation, (60, 3, 3)))
    solved = inverse_kinematics(rods, tool, limits=False)
    keep = solved.ok
    found = compute_positioning_errors(
        build_device(rods, errors), errors, solved.q[keep], tool.take(keep), methods=["parallelepiped"]
    )
    columns = {f"face {k + 1}": found.faces[:, k] for k in range(3)}
    return pd.DataFrame({"y": position[keep, 1], "z": position[keep, 2]} | columns)


def enlarged(robot, rods, home: Poses) -> pd.DataFrame:
    """Return every bound at home with all errors of Table 4.2 times a factor, in mm."""
    rows = []
    for case, errors in CASES.items():
        grown = scale_errors(rods, errors, robot.home, home, METHODS[:-1])
        for k, factor in enumerate(grown.factors):
            rows.append({"case": case, "factor": factor} | {m: 1e3 * x[k] for m, x in grown.largest.items()})
    return pd.DataFrame(rows)


def singular(robot, rods) -> pd.DataFrame:
    """Return every bound, errors of case 1, as the tool nears the plane of the three base points (det = 0), in um.

    Rods are shortened so that the tool sinks from home towards that plane with the carts at rest.
    """
    A = rods.base_points(robot.home[None])[0]
    normal = np.cross(A[1] - A[0], A[2] - A[0])
    normal /= np.linalg.norm(normal)
    at = forward_kinematics(rods, robot.home[None]).poses.position[0]
    height, rows = float((at - A[0]) @ normal), []
    errors = CASES["case 1"]
    for share in (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005):
        tool = at - (1 - share) * height * normal
        values = {f"arm{k + 1}.length": {"value": float(np.linalg.norm(tool - A[k]))} for k in range(3)}
        near = rods.with_geometry(rods.geometry.update(values))
        poses = forward_kinematics(near, robot.home[None]).poses
        found = compute_positioning_errors(build_device(near, errors), errors, robot.home[None], poses, samples=2000)
        rows.append({"height [mm]": 1e3 * abs(share * height)} | {m: 1e6 * x[0] for m, x in found.largest.items()})
    return pd.DataFrame(rows)


def draw(out_dir: Path, rods, found: dict, line: pd.DataFrame) -> None:
    """Draw Figures 4.8, 4.10 (thesis' method) and 4.9."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    pierced = guideways(rods)
    for case, number in (("case 1", "4_8"), ("case 2", "4_10")):
        fig, axes = plt.subplots(1, 2, figsize=(11, 5), constrained_layout=True)
        for ax, area in zip(axes, AREAS, strict=True):
            grid, a = found[area, case].grid, found[area, case].accuracy
            drawn = ax.contourf(grid.u, grid.v, 1e6 * grid.on_grid(a.largest["exact"]), levels=12, cmap="magma_r")
            ax.contour(
                grid.u, grid.v, 1e6 * grid.on_grid(a.largest["exact"]), levels=drawn.levels, colors="k", linewidths=0.4
            )
            ax.plot(pierced[:, 1], pierced[:, 2], "ks", ms=7)
            ax.set(xlabel="y [m]", ylabel="z [m]", aspect="equal", title=area)
            fig.colorbar(drawn, ax=ax, label="largest positioning error [um]")
        fig.suptitle(f"Figure {number.replace('_', '.')}: {case} of Table 4.2, exact worst case")
        _save(fig, out_dir / f"figure_{number}")
    fig, ax = plt.subplots(figsize=(6.5, 4), constrained_layout=True)
    for k, style in ((1, "-"), (2, "-."), (3, "--")):
        ax.plot(line["y"], 1e12 * line[f"face {k}"], f"k{style}", label=f"orthogonal to link {k}")
    ax.set(
        xlabel="y along the diagonal [m]",
        ylabel="face area [um$^2$]",
        title="Figure 4.9: parallelepiped's faces, case 1",
    )
    ax.legend()
    _save(fig, out_dir / "figure_4_9")


def _save(fig, path: Path) -> None:
    for suffix in (".png", ".svg"):
        fig.savefig(path.with_suffix(suffix), dpi=110)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out_dir", type=Path, nargs="?", default=Path("out/thesis_4_3"))
    parser.add_argument("--grid", type=int, default=41)
    parser.add_argument("--samples", type=int, default=500)
    parser.add_argument("--seed", type=int, default=43)
    given = parser.parse_args()
    main(given.out_dir, given.grid, given.samples, given.seed)
