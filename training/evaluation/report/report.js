"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const hidden = new Set();
const redraws = [];
const dark = matchMedia("(prefers-color-scheme: dark)");

function element(tag, attributes = {}, ...children) {
  const found = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key in found && key !== "list") found[key] = value; else found.setAttribute(key, value);
  }
  found.append(...children);
  return found;
}

function short(value) {
  if (value === null || value === undefined) return "–";
  return Number.isInteger(value) || Math.abs(value) >= 100 ? value.toFixed(0) : Number(value.toPrecision(3)).toString();
}

function css(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

function layout(more = {}) {
  const axis = { gridcolor: css("--rule"), zerolinecolor: css("--rule"), linecolor: css("--rule") };
  const base = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", autosize: true,
    font: { color: css("--ink"), family: "system-ui, sans-serif", size: 12 },
    margin: { l: 55, r: 15, t: 40, b: 45 }, modebar: { bgcolor: "rgba(0,0,0,0)", color: css("--muted"), activecolor: css("--accent") }, showlegend: false, hovermode: "closest",
  };
  const found = { ...base, ...more };
  for (const key of ["xaxis", "yaxis"]) found[key] = { ...axis, ...(more[key] || {}) };
  return found;
}

const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["lasso2d", "select2d"] };

function figure(parent, traces, more) {
  const box = element("div", { className: "plot" });
  parent.append(box);
  const draw = () => Plotly.react(box, traces(), layout(more()), options);
  redraws.push(draw);
  return draw;
}

const title = text => ({ text, x: 0.02, xanchor: "left", font: { size: 14 } });

// ------------------------------------------------------------------ summary

function summary() {
  const table = document.getElementById("summary");
  const several = data.runs.length > 1;
  const columns = [...(several ? ["run"] : []), "agent", ...Object.keys(data.titles)];
  const value = (row, column) => column === "run" || column === "agent" ? row[column] : row.values[column];
  let order = null, down = false;
  const colours = {};
  for (const run of data.runs) for (const [name, one] of Object.entries(run.agents)) colours[name] ??= one.colour;

  function draw() {
    const rows = [...data.rows];
    if (order) rows.sort((a, b) => {
      const x = value(a, order), y = value(b, order);
      if (x === null || x === undefined) return 1;
      if (y === null || y === undefined) return -1;
      return (typeof x === "string" ? x.localeCompare(y) : x - y) * (down ? -1 : 1);
    });
    const head = element("tr");
    for (const column of columns) {
      const name = column === "run" || column === "agent";
      const cell = element("th", { className: name ? "name" : "", scope: "col" },
        element("button", { type: "button", onclick: () => { down = order === column && !down; order = column; draw(); } },
          data.titles[column] || column));
      if (order === column) cell.setAttribute("aria-sort", down ? "descending" : "ascending");
      head.append(cell);
    }
    const best = {};
    for (const column of Object.keys(data.titles)) if (column !== "nees") {
      for (const run of data.runs) {
        const found = data.rows.filter(r => r.run === run.name && r.agent !== "bound").map(r => r.values[column]).filter(v => typeof v === "number");
        if (found.length > 1) best[run.name + "/" + column] = Math.min(...found);
      }
    }
    const body = element("tbody");
    for (const row of rows) {
      const line = element("tr", { className: hidden.has(row.agent) ? "off" : "" });
      for (const column of columns) {
        if (column === "agent") {
          const swatch = element("span", { className: "swatch" });
          swatch.style.background = row.agent === "bound" ? css("--ink") : colours[row.agent] || "transparent";
          line.append(element("td", { className: "name" }, element("button", { type: "button", onclick: () => {
            if (!hidden.delete(row.agent)) hidden.add(row.agent);
            draw(); redraws.forEach(f => f());
          } }, swatch, row.agent)));
        } else if (column === "run") line.append(element("td", { className: "name" }, row.run));
        else {
          const v = row.values[column];
          line.append(element("td", { className: v === best[row.run + "/" + column] && row.agent !== "bound" ? "best" : "" }, short(v)));
        }
      }
      body.append(line);
    }
    table.replaceChildren(element("thead", {}, head), body);
  }
  draw();
}

// ------------------------------------------------------------------ curves

function curves(run, parent) {
  const grid = element("div", { className: "grid" });
  parent.append(grid);
  const shown = () => Object.entries(run.agents).filter(([name]) => !hidden.has(name));
  const line = (name, x, y, colour, more = {}) => ({ name, x, y, mode: "lines", line: { color: colour, width: 1.6 }, ...more });
  const black = () => ({ color: css("--ink"), width: 1.3, dash: "dash" });

  figure(grid, () => [
    ...shown().map(([name, one]) => line(name, run.time, one.error, one.colour)),
    ...(run.bound && !hidden.has("bound") ? [{ ...line("bound", run.time, run.bound, ""), line: black() }] : []),
  ], () => ({ title: title("Position error over time"), xaxis: { title: { text: "time (s)" } }, yaxis: { type: "log", title: { text: "RMS error (m)" } } }));

  figure(grid, () => [
    { x: [...run.time, ...[...run.time].reverse()], y: [...run.band[1], ...[...run.band[0]].reverse()], fill: "toself",
      mode: "none", fillcolor: "rgba(127,127,127,.35)", hoverinfo: "skip", name: "95 % band" },
    ...shown().map(([name, one]) => line(name, run.time, one.nees, one.colour)),
  ], () => ({ title: title(`Consistency: NEES, ${run.dim} is honest (band: 95 %)`), xaxis: { title: { text: "time (s)" } }, yaxis: { type: "log", title: { text: "NEES" } } }));

  figure(grid, () => shown().map(([name, one]) => line(name, one.quantile, one.share, one.colour)),
    () => ({ title: title("Distribution of errors"), xaxis: { type: "log", title: { text: "position error (m)" } }, yaxis: { range: [0, 100], title: { text: "share below (%)" } } }));

  const names = Object.keys(run.agents);
  let chosen = best(run);
  const box = element("div");
  grid.append(box);
  const select = element("select", { "aria-label": "agent whose UAVs are shown", onchange: () => { chosen = select.value; draw(); } },
    ...names.map(name => element("option", { value: name }, name)));
  select.value = chosen;
  const draw = figure(box, () => run.agents[chosen].uav_error.map((y, i) => line(`UAV ${i}`, run.time, y, palette[i % palette.length])),
    () => ({ title: title(`Error of each UAV: ${chosen}`), xaxis: { title: { text: "time (s)" } }, yaxis: { type: "log", title: { text: "RMS error (m)" } } }));
  if (names.length > 1) box.append(element("div", { className: "controls" }, select));
}

/** The agent with the smallest error. */
function best(run) {
  const rows = data.rows.filter(row => row.run === run.name && row.agent in run.agents);
  const error = row => row.values.rmse ?? Infinity;
  return rows.reduce((a, b) => error(b) < error(a) ? b : a).agent;
}

const palette = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#882255", "#7F7F1F"];

// ------------------------------------------------------------------ player

function unpack(text, Type) {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  return Type === Uint8Array ? bytes : new Type(bytes.buffer);
}

function player(run, parent) {
  const p = run.player, n = run.uavs, names = Object.keys(p.estimates);
  const truth = unpack(p.truth, Float32Array), links = unpack(p.links, Uint8Array), scored = unpack(p.scored, Uint8Array);
  const estimates = {}, axes = {};
  for (const name of names) { estimates[name] = unpack(p.estimates[name], Float32Array); axes[name] = unpack(p.axes[name], Float32Array); }
  let agent = best(run), frame = 0, timer = null;
  const at = (array, k, i, a) => array[(k * n + i) * 3 + a];
  const three = (array, k, i) => [0, 1, 2].map(a => at(array, k, i, a));

  function trail(array, k, length) {
    const x = [], y = [], z = [];
    for (let i = 0; i < n; i++) {
      for (let j = Math.max(0, k - length); j <= k; j++) { const c = three(array, j, i); x.push(c[0]); y.push(c[1]); z.push(c[2]); }
      x.push(null); y.push(null); z.push(null);
    }
    return { x, y, z };
  }
  function points(array, k) {
    const x = [], y = [], z = [], text = [];
    for (let i = 0; i < n; i++) { const c = three(array, k, i); x.push(c[0]); y.push(c[1]); z.push(c[2]); text.push(`UAV ${i}` + (scored[k * n + i] ? "" : " (not scored)")); }
    return { x, y, z, text };
  }
  function ellipsoids(k) {
    const x = [], y = [], z = [], pairs = run.dim === 3 ? [[0, 1], [1, 2], [0, 2]] : [[0, 1]];
    for (let i = 0; i < n; i++) {
      const centre = three(estimates[agent], k, i);
      const axis = c => [0, 1, 2].map(r => axes[agent][((k * n + i) * 3 + r) * 3 + c]);
      if (!Number.isFinite(axis(0)[0])) continue;
      for (const [a, b] of pairs) {
        const u = axis(a), v = axis(b);
        for (let s = 0; s <= 24; s++) {
          const c = Math.cos(s * Math.PI / 12), d = Math.sin(s * Math.PI / 12);
          x.push(centre[0] + c * u[0] + d * v[0]); y.push(centre[1] + c * u[1] + d * v[1]); z.push(centre[2] + c * u[2] + d * v[2]);
        }
        x.push(null); y.push(null); z.push(null);
      }
    }
    return { x, y, z };
  }
  function network(k) {
    const x = [], y = [], z = [];
    for (let i = 0; i < n; i++) for (let j = 0; j < n; j++) {
      const bit = (k * n + i) * n + j;
      if (i !== j && (links[bit >> 3] >> (7 - (bit & 7))) & 1) {
        const a = three(truth, k, i), b = three(truth, k, j);
        x.push(a[0], b[0], null); y.push(a[1], b[1], null); z.push(a[2], b[2], null);
      }
    }
    return { x, y, z };
  }
  function room() {
    const [a, b] = [p.low, p.high], x = [], y = [], z = [];
    const path = list => { for (const c of list) { x.push(c[0]); y.push(c[1]); z.push(c[2]); } x.push(null); y.push(null); z.push(null); };
    for (const h of run.dim === 3 ? [a[2], b[2]] : [0]) path([[a[0], a[1], h], [b[0], a[1], h], [b[0], b[1], h], [a[0], b[1], h], [a[0], a[1], h]]);
    if (run.dim === 3) for (const [u, v] of [[a[0], a[1]], [b[0], a[1]], [b[0], b[1]], [a[0], b[1]]]) path([[u, v, a[2]], [u, v, b[2]]]);
    return { x, y, z };
  }
  const few = run.uavs <= 30;
  const traces = () => {
    const colour = run.agents[agent].colour, ink = css("--ink"), muted = css("--muted");
    const found = [
      { ...room(), name: "arena", mode: "lines", line: { color: muted, width: 1 }, hoverinfo: "skip" },
      { ...network(frame), name: "links", mode: "lines", line: { color: muted, width: 1 }, opacity: .5, hoverinfo: "skip" },
      { ...trail(truth, frame, few ? 40 : 8), name: "truth (trail)", mode: "lines", line: { color: ink, width: 3 }, opacity: .5, hoverinfo: "skip", showlegend: false },
      { ...points(truth, frame), name: "truth", mode: "markers", marker: { color: ink, size: few ? 5 : 2.5 } },
      { ...points(estimates[agent], frame), name: agent, mode: "markers", marker: { color: colour, size: few ? 4 : 2, symbol: "diamond" } },
      { ...ellipsoids(frame), name: "95 % ellipsoid", mode: "lines", line: { color: colour, width: 2 }, hoverinfo: "skip" },
    ];
    for (const [name, places] of Object.entries(p.places)) found.push({
      x: places.map(c => c[0]), y: places.map(c => c[1]), z: places.map(c => c[2]), name, mode: "markers",
      marker: { color: name === "anchors" ? "#E69F00" : muted, size: 3, symbol: name === "anchors" ? "square" : "circle" } });
    return found.map(trace => ({ type: "scatter3d", ...trace }));
  };
  const side = Math.max(...[0, 1].map(a => p.high[a] - p.low[a]));
  const within = a => [p.low[a] - .05 * side, p.high[a] + .05 * side];
  const scene = () => {
    const axis = (text, a) => ({ range: within(a), title: { text }, color: css("--muted"), gridcolor: css("--rule"), backgroundcolor: "rgba(0,0,0,0)" });
    return { uirevision: run.name, title: title("First run"), showlegend: true, legend: { orientation: "h", y: 0, bgcolor: "rgba(0,0,0,0)" },
      margin: { l: 0, r: 0, t: 40, b: 0 },
      scene: { aspectmode: run.dim === 3 ? "data" : "manual", aspectratio: run.dim === 3 ? undefined : { x: 1, y: (p.high[1] - p.low[1]) / (p.high[0] - p.low[0]), z: .05 },
        camera: run.dim === 3 ? undefined : { eye: { x: 0, y: 0, z: 1.6 }, up: { x: 0, y: 1, z: 0 } },
        xaxis: axis("x (m)", 0), yaxis: axis("y (m)", 1), zaxis: { ...axis(run.dim === 3 ? "z (m)" : "", 2), visible: run.dim === 3 } } };
  };
  const box = element("div", { className: "player" });
  parent.append(box);
  const redraw = figure(box, traces, scene);
  const clock = element("output", {}, "0 s");
  const slider = element("input", { type: "range", min: 0, max: p.frames - 1, value: 0, "aria-label": "time", oninput: () => show(Number(slider.value)) });
  function show(k) { frame = k; slider.value = k; clock.textContent = `${short(p.time[k])} s`; redraw(); }
  const play = element("button", { type: "button", onclick: () => {
    if (timer) { clearInterval(timer); timer = null; play.textContent = "Play"; return; }
    play.textContent = "Pause";
    timer = setInterval(() => show((frame + 1) % p.frames), 80);
  } }, "Play");
  const select = element("select", { "aria-label": "agent in the player", onchange: () => { agent = select.value; redraw(); } },
    ...names.map(name => element("option", { value: name }, name)));
  select.value = agent;
  box.append(element("div", { className: "controls" }, play, slider, clock, select));
  return (step, name) => {
    let k = p.steps.findIndex(s => s >= step);
    if (k < 0) k = p.frames - 1;
    agent = name; select.value = name; show(k);
    box.scrollIntoView({ behavior: "smooth", block: "center" });
  };
}

// ------------------------------------------------------------------ page

function moments(run, parent, go) {
  const table = element("table");
  const head = element("tr", {}, ...["agent", "run (seed)", "UAV", "time (s)", "error (m)", "NEES", ""].map((text, i) => element("th", { className: i ? "" : "name" }, text)));
  const body = element("tbody");
  for (const one of run.worst) {
    const link = one.run === 0 ? element("button", { type: "button", onclick: () => go(one.step, one.agent) }, "show") : "";
    body.append(element("tr", {}, element("td", { className: "name" }, one.agent),
      ...[`${one.run} (${one.seed})`, one.uav, short(one.time), short(one.error), short(one.nees), link].map(text => element("td", {}, text))));
  }
  table.append(element("thead", {}, head), body);
  parent.append(element("h3", {}, "Worst moments"), element("p", { className: "note" }, "Each agent's largest errors; those of the first run can be seen in the player."),
    element("div", { className: "scroll" }, table));
}

summary();
const everything = document.getElementById("runs");
for (const run of data.runs) {
  const section = element("section", {}, element("h2", {}, run.name));
  everything.append(section);
  const list = element("dl");
  for (const [key, value] of Object.entries(run.settings)) list.append(element("dt", {}, key), element("dd", {}, value));
  section.append(list, element("code", {}, run.command));
  curves(run, section);
  const go = player(run, section);
  moments(run, section, go);
}
dark.addEventListener("change", () => redraws.forEach(f => f()));
redraws.forEach(draw => draw());
document.body.dataset.ready = "yes";
