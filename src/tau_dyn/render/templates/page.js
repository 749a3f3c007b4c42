"use strict";
// The time view: one joint of one log at a time, strips that share their time and zoom together.
(() => {
  const panels = JSON.parse(document.getElementById("panels").textContent);
  const viewer = document.querySelector(".viewer");
  if (!panels.length || !viewer) return;
  const tabs = viewer.querySelector(".tabs"), select = viewer.querySelector("select");
  const unpack = (s) => {
    const bytes = Uint8Array.from(atob(s.data), (c) => c.charCodeAt(0)), view = new DataView(bytes.buffer);
    return Array.from({ length: bytes.length / 2 }, (_, k) => {
      const number = view.getInt16(2 * k, true);
      return number === -32768 ? null : s.middle + s.scale * number;
    });
  };
  const short = (v, most) => {
    const text = most >= 2e-3 && most < 1e5 || v === 0 ? String(Number(v.toPrecision(6))) : Number(v.toPrecision(3)).toExponential();
    return text.replace(/-/g, "−");
  };
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const joints = [...new Set(panels.map((p) => p.joint))];
  const stretches = panels.filter((p) => p.joint === joints[0]);
  let joint = joints[0], stretch = 0, plots = [], shown = [];

  const shade = (panel, masks) => (u) => {
    const fill = (from, to, name) => {
      const left = Math.max(u.valToPos(from, "x", true), u.bbox.left);
      const right = Math.min(u.valToPos(to, "x", true), u.bbox.left + u.bbox.width);
      u.ctx.fillStyle = colour(name);
      if (right > left) u.ctx.fillRect(left, u.bbox.top, right - left, u.bbox.height);
    };
    panel.bands.forEach(([from, to, ink]) => fill(from, to, `--${ink}`));
    if (masks) panel.masked.forEach(([from, to]) => fill(from, to, "--masked"));
  };
  const sync = uPlot.sync("time");
  const readout = viewer.querySelector("output");
  const read = (u) => {
    const k = u.cursor.idx;
    if (k === null || k === undefined || plots.length < shown.length) return readout.replaceChildren();
    const show = (v) => v === null || v === undefined ? "–" : v.toPrecision(4).replace("-", "−");
    const values = shown.flatMap((strip, i) => strip.curves.map((c, j) => `${c.name} ${show(plots[i].data[j + 1][k])}`));
    readout.textContent = [`t ${plots[0].data[0][k].toFixed(3)} s`, ...values].join("   ");
  };
  const bound = (strip) => (u) => strip.bounds.forEach((value) => {
    const y = u.valToPos(value, "y", true);
    u.ctx.save();
    u.ctx.strokeStyle = colour("--poor");
    u.ctx.setLineDash([6, 5]);
    u.ctx.beginPath();
    u.ctx.moveTo(u.bbox.left, y);
    u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
    u.ctx.stroke();
    u.ctx.restore();
  });
  const chart = (panel, where, t, strip, last) => {
    const axis = { stroke: colour("--muted"), grid: { stroke: colour("--grid"), width: 1 }, ticks: { show: false }, values: (_, at) => at.map((v) => (v === null ? "" : short(v, Math.max(...at.map((x) => Math.abs(x ?? 0)))))), font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", labelSize: 18 };
    const follow = (u) => plots.forEach((p) => {
      if (p !== u && (p.scales.x.min !== u.scales.x.min || p.scales.x.max !== u.scales.x.max)) p.setScale("x", { min: u.scales.x.min, max: u.scales.x.max });
    });
    return new uPlot({
      width: where.clientWidth, height: strip.height, cursor: { sync: { key: sync.key }, drag: { x: true, y: false }, y: false, points: { show: false } },
      scales: { x: { time: false }, y: { range: strip.limits } }, legend: { show: false },
      axes: [{ ...axis, label: last ? "time [s]" : null, size: 26, space: 80 }, { ...axis, label: strip.label, size: 50, space: strip.height < 200 ? 24 : 34 }],
      series: [{}, ...strip.curves.map((c) => ({ stroke: colour(`--${c.ink}`), width: c.width, points: { show: false } }))],
      hooks: { drawClear: [shade(panel, strip.masked)], draw: [bound(strip)], setScale: [(u, key) => key === "x" && follow(u)], setCursor: [read] },
    }, [t, ...strip.curves.map(unpack)], where);
  };
  const draw = () => {
    const panel = panels.filter((p) => p.joint === joint)[stretch];
    const range = plots.length ? [plots[0].scales.x.min, plots[0].scales.x.max, plots[0].stretch === stretch] : null;
    plots.forEach((p) => p.destroy());
    plots = [];
    shown = panel.strips;
    const t = Float64Array.from({ length: panel.n }, (_, k) => panel.t0 + k * panel.step);
    plots = shown.map((strip, k) => chart(panel, viewer.querySelector(".plots"), t, strip, k === shown.length - 1));
    plots[0].stretch = stretch;
    if (range && range[2]) plots[0].setScale("x", { min: range[0], max: range[1] });
    [...tabs.children].forEach((b) => b.setAttribute("aria-pressed", b.textContent === joint));
  };
  joints.forEach((name) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.hidden = !name;
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
