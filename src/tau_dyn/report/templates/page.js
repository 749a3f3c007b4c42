"use strict";
// The time view: one joint of one log at a time, force above and residual below, zoomed together.
(() => {
  const panels = JSON.parse(document.getElementById("panels").textContent);
  const viewer = document.querySelector(".viewer");
  if (!panels.length || !viewer) return;
  const tabs = viewer.querySelector(".tabs"), select = viewer.querySelector("select");
  const unpack = (s) => {
    const bytes = Uint8Array.from(atob(s.data), (c) => c.charCodeAt(0)), view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, k) => s.middle + s.scale * view.getInt16(2 * k, true));
  };
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const joints = [...new Set(panels.map((p) => p.joint))];
  const stretches = panels.filter((p) => p.joint === joints[0]);
  let joint = joints[0], stretch = 0, plots = [];

  const shade = (panel, masks) => (u) => {
    const fill = (from, to, name) => {
      const left = Math.max(u.valToPos(from, "x", true), u.bbox.left);
      const right = Math.min(u.valToPos(to, "x", true), u.bbox.left + u.bbox.width);
      u.ctx.fillStyle = colour(name);
      if (right > left) u.ctx.fillRect(left, u.bbox.top, right - left, u.bbox.height);
    };
    if (panel.heldOut) fill(u.scales.x.min, u.scales.x.max, "--held");
    else if (panel.shaded) fill(panel.shaded[0], panel.shaded[1], "--held");
    if (masks) panel.masked.forEach(([from, to]) => fill(from, to, "--masked"));
  };
  const sync = uPlot.sync("time");
  const readout = viewer.querySelector("output");
  const read = (u) => {
    const k = u.cursor.idx, [a, b] = plots;
    if (k === null || k === undefined || !b) return readout.replaceChildren();
    const show = (v) => v.toPrecision(4).replace("-", "−");
    readout.textContent = `t ${a.data[0][k].toFixed(3)} s   measured ${show(a.data[1][k])}   predicted ${show(a.data[2][k])}   residual ${show(b.data[1][k])}`;
  };
  const chart = (panel, where, height, series, label, data, masks) => {
    const axis = { stroke: colour("--muted"), grid: { stroke: colour("--grid"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", labelSize: 18 };
    const follow = (u) => plots.forEach((p) => {
      if (p !== u && (p.scales.x.min !== u.scales.x.min || p.scales.x.max !== u.scales.x.max)) p.setScale("x", { min: u.scales.x.min, max: u.scales.x.max });
    });
    return new uPlot({
      width: where.clientWidth, height, cursor: { sync: { key: sync.key }, drag: { x: true, y: false }, y: false, points: { show: false } },
      scales: { x: { time: false }, y: { range: panel.limits[masks ? 1 : 0] } }, legend: { show: false },
      axes: [{ ...axis, label: masks ? "time [s]" : null, size: 26, space: 80 }, { ...axis, label, size: 50, space: masks ? 24 : 34 }],
      series: [{}, ...series.map(([css, width]) => ({ stroke: colour(css), width, points: { show: false } }))],
      hooks: { drawClear: [shade(panel, masks)], setScale: [(u, key) => key === "x" && follow(u)], setCursor: [read] },
    }, data, where);
  };
  const draw = () => {
    const panel = panels.filter((p) => p.joint === joint)[stretch];
    const range = plots.length ? [plots[0].scales.x.min, plots[0].scales.x.max, plots[0].stretch === stretch] : null;
    plots.forEach((p) => p.destroy());
    plots = [];
    const t = Float64Array.from({ length: panel.n }, (_, k) => panel.t0 + k * panel.step);
    const [measured, predicted, residual] = panel.series.map(unpack);
    const made = [
      chart(panel, viewer.querySelector(".upper"), 290, [["--measured", 3], ["--predicted", 1.2]], `force [${panel.unit}]`, [t, measured, predicted], false),
      chart(panel, viewer.querySelector(".lower"), 180, [["--residual", 1]], `residual [${panel.unit}]`, [t, residual], true),
    ];
    plots = made;
    plots[0].stretch = stretch;
    if (range && range[2]) plots[0].setScale("x", { min: range[0], max: range[1] });
    [...tabs.children].forEach((b) => b.setAttribute("aria-pressed", b.textContent === joint));
  };
  joints.forEach((name) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.addEventListener("click", () => { joint = name; draw(); });
    tabs.append(button);
  });
  stretches.forEach((p, k) => select.append(new Option(`${p.log}${p.heldOut ? " (held out)" : ""}${stretches.filter((s) => s.log === p.log).length > 1 ? `, from ${p.t0.toFixed(1)} s` : ""}`, k)));
  select.parentElement.hidden = stretches.length < 2;
  select.addEventListener("change", () => { stretch = Number(select.value); draw(); });
  viewer.querySelector(".reset").addEventListener("click", () => plots.forEach((p) => p.setScale("x", { min: p.data[0][0], max: p.data[0].at(-1) })));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  addEventListener("resize", () => plots.forEach((p) => p.setSize({ width: p.root.parentElement.clientWidth, height: p.height })));
  document.documentElement.classList.add("live");
  viewer.hidden = false;
  draw();
})();
