// Panel `trend`: curves of variables over a window of time.

import uPlot from "./uPlot.js";
import { Curves, windowSeconds } from "./curves.js";
import { h, setAttribute, setText } from "./dom.js";
import { formatNumber, formatTime, formatValue, t } from "./language.js";
import { describe, hrefOf, inputOf, matchesAny, namesIn, resolve } from "./names.js";
import { pathOf } from "./panel-set.js";

const COLORS = 8;
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]];
const HEIGHT = 230;
const MIN_PERIOD_MS = 200;
const MIN_SELECTION = 4; // pixels: less is a click
const SHOWN_AXES = 2; // the legend has the values of all curves
const CLOCK_STEP_S = 5;
const WINDOWS = ["30s", "2m", "10m", "1h", "8h"];

const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Panel `trend`: `{element, tools}`. */
export function trendPanel(panel, scope) {
  const { app } = scope;
  const names = resolve(panel.of, app.variables, app.stations);
  if (!names.length) return { element: h("p", { class: "note" }, t("no_variables")) };
  const position = new Map(names.map((name, index) => [name, index]));
  const plotFrame = h("div", { class: "plot", tabindex: "0", role: "slider", "aria-valuemin": "0", "aria-valuemax": "100", "aria-valuenow": "100", "aria-label": t("trend_of", { names: names.join(", "), window: panel.window }) });
  const legend = h("ul", { class: "legend" });
  const cursorTime = legend.appendChild(h("li", { class: "at", hidden: true }));
  const readings = names.map((name, index) => legendItem(name, index, panel, scope, legend));
  const element = h("div", { class: "trend" }, plotFrame, legend);

  let windowS = windowSeconds(panel.window);
  let curves = new Curves(names.length, windowS);
  let plot = null;
  let isShown = false;
  let latest = Date.now() / 1000;
  let drawnAt = 0;
  let held = null; // while paused: `{data, from, until}`
  const range = () => (held ? [held.from, held.until] : [latest - windowS, latest]);
  const draw = () => {
    if (!isShown || document.hidden) return;
    drawnAt = performance.now();
    plot ??= makePlot(plotFrame, names, panel, { range, readings, cursorTime, zoom, follow });
    plot.setData(held?.data ?? curves.arrays(latest));
  };
  let frame = 0;
  const drawSoon = () => {
    const periodMs = Math.min(1000, Math.max(MIN_PERIOD_MS, (windowS * 1000) / 600));
    if (held || frame || performance.now() - drawnAt < periodMs - 20) return;
    frame = requestAnimationFrame(() => {
      frame = 0;
      draw();
    });
  };

  const pause = h("button", { type: "button", class: "tool", onclick: () => (held ? follow() : zoom(...range())) }, t("trend_pause"));
  const choice = h("select", { class: "tool", "aria-label": t("trend_window") }, windowsUpTo(panel.window).map((text) => h("option", { value: text, selected: text === panel.window }, text)));
  choice.addEventListener("change", () => {
    windowS = windowSeconds(choice.value);
    curves = new Curves(names.length, windowS);
    follow();
    load();
  });
  const save = h("button", { type: "button", class: "tool", title: t("trend_save"), onclick: () => saveCsv(panel, scope, names, held?.data ?? curves.arrays(latest), range()) }, "CSV");
  /** Hold the curves, and show this part of them. */
  function zoom(from, until) {
    held = { data: held?.data ?? curves.arrays(latest), from, until: Math.max(until, from + windowS / 1200) };
    setText(pause, t("trend_follow"));
    setAttribute(pause, "class", "tool held");
    draw();
  }
  function follow() {
    held = null;
    setText(pause, t("trend_pause"));
    setAttribute(pause, "class", "tool");
    draw();
  }

  scope.sample((message) => {
    const fresh = names.filter((name) => message.values[name]);
    if (!fresh.length) return;
    if (message.time < latest - CLOCK_STEP_S) curves.clear(); // the clock was set back
    for (const name of fresh) {
      const [value, , stale] = message.values[name];
      curves.add(message.time, position.get(name), stale ? null : value);
    }
    latest = message.time;
    drawSoon();
  });
  const load = async () => {
    const wanted = curves;
    const query = `?window=${encodeURIComponent(choice.value)}`;
    for (const pattern of namesIn(panel.of)) {
      if (!isKept(pattern, app)) continue;
      const found = await app.connection.get(`history/${pathOf(pattern)}${query}`).catch(() => ({}));
      for (const [name, { times, values }] of Object.entries(found)) {
        if (!position.has(name)) continue;
        times.forEach((time, index) => wanted.add(time, position.get(name), values[index]));
        latest = Math.max(latest, times.at(-1) ?? 0);
      }
    }
    draw();
  };
  // Before the first message and after a gap in the connection the server knows what was.
  scope.on("state", (state) => {
    if (state === "open") load();
  });
  plotFrame.addEventListener("keydown", (event) => {
    if (plot && moveCursor(plot, event, { range, zoom, follow })) {
      event.preventDefault();
      const texts = readings.map((read, index) => `${names[index]} ${read.text()}`);
      setAttribute(plotFrame, "aria-valuenow", Math.round((100 * plot.cursor.left) / plot.over.clientWidth));
      setAttribute(plotFrame, "aria-valuetext", [cursorTime.textContent, ...texts].join("; "));
    }
  });
  const width = new ResizeObserver(() => plot?.setSize({ width: plotFrame.clientWidth, height: HEIGHT }));
  width.observe(plotFrame);
  const visible = new IntersectionObserver(([entry]) => {
    isShown = entry.isIntersecting;
    draw();
  });
  visible.observe(plotFrame);
  const redraw = () => plot?.redraw(false);
  scope.listen(matchMedia("(prefers-color-scheme: dark)"), "change", redraw);
  scope.listen(matchMedia("print"), "change", redraw);
  scope.listen(document, "visibilitychange", draw);
  scope.listen(window, "beforeprint", () => {
    isShown = true; // paper has all panels
    draw();
  });
  scope.atEnd(() => {
    width.disconnect();
    visible.disconnect();
    cancelAnimationFrame(frame);
    plot?.destroy();
  });
  return { element, tools: [choice, pause, save] };
}

/** Return the choices of a window: those that are shorter than the panel's, and this one. */
function windowsUpTo(text) {
  return [...WINDOWS.filter((each) => windowSeconds(each) < windowSeconds(text)), text];
}

/** Move the cursor of a plot, or zoom, by a key; return whether the key has a meaning. */
function moveCursor(plot, { key, shiftKey }, { range, zoom, follow }) {
  const { width, height } = plot.over.getBoundingClientRect();
  const at = plot.cursor.left >= 0 ? plot.cursor.left : width - 1;
  const step = (shiftKey ? 0.1 : 0.01) * width;
  const places = { ArrowLeft: at - step, ArrowRight: at + step, Home: 0, End: width - 1 };
  const factor = { "+": 0.5, "-": 2 }[key];
  if (key in places) {
    plot.setCursor({ left: Math.min(width - 1, Math.max(0, places[key])), top: height / 2 });
  } else if (factor) {
    const [from, until] = range();
    const middle = plot.posToVal(at, "x");
    zoom(middle - (middle - from) * factor, middle + (until - middle) * factor);
  } else if (key === "Escape") {
    plot.setCursor({ left: -10, top: -10 });
    follow();
  } else {
    return false;
  }
  return true;
}

/** Have the browser save the shown part of the curves. */
function saveCsv(panel, scope, names, [times, ...values], [from, until]) {
  const quoted = (text) => `"${text.replaceAll('"', '""')}"`;
  const heads = names.map((name) => {
    const unit = panel.unit || describe(name, scope.app.variables)?.unit;
    return quoted(unit ? `${name} [${unit}]` : name);
  });
  const lines = [`time,${heads.join(",")}`];
  times.forEach((time, index) => {
    const row = values.map((curve) => curve[index] ?? "");
    if (time < from || time > until || row.every((each) => each === "")) return;
    lines.push([new Date(time * 1000).toISOString(), ...row].join(","));
  });
  const file = URL.createObjectURL(new Blob([`${lines.join("\r\n")}\r\n`], { type: "text/csv" }));
  const stamp = new Date(until * 1000).toISOString().slice(0, 19).replaceAll(":", "");
  h("a", { href: file, download: `${(panel.title || names[0]).replace(/[^\p{L}\p{N}.-]+/gu, "-")}-${stamp}.csv` }).click();
  URL.revokeObjectURL(file);
}

/** Return whether the server keeps the last values of what fits: those of trends of the pages. */
function isKept(pattern, app) {
  const trends = app.pages.flatMap((page) => page.panels).filter((each) => each.kind === "trend");
  return trends.some((each) => namesIn(each.of).includes(pattern) || matchesAny(each.of, pattern));
}

function legendItem(name, index, panel, scope, legend) {
  const { app } = scope;
  const unit = panel.unit || describe(name, app.variables)?.unit || "";
  const value = h("span", { class: "number" });
  const item = h("li", { class: `curve-${index % COLORS} dash-${Math.floor(index / COLORS) % DASHES.length}` },
    h("span", { class: "line", "aria-hidden": "true" }), h("a", { class: "name", href: hrefOf("variable", name) }, name), " ", value, " ", h("span", { class: "unit" }, unit));
  legend.append(item);
  const isWhole = inputOf(describe(name, app.variables)?.type ?? "").whole;
  let cursor;
  let shown = { value: null, stale: true };
  let decimals = null;
  const format = (each) => formatValue(each, isWhole || !Number.isFinite(each) ? null : decimals);
  const show = () => {
    const isPresent = cursor === undefined;
    setText(value, isPresent ? format(shown.value) + (shown.stale ? " ?" : "") : format(cursor));
    setAttribute(value, "class", isPresent && shown.stale ? "number stale" : "number");
  };
  scope.watch(name, (each) => {
    shown = each;
    show();
  });
  return {
    at(given) {
      cursor = given;
      show();
    },
    scale(given) {
      if (decimals === given) return;
      decimals = given;
      show();
    },
    unit,
    text: () => `${value.textContent} ${unit}`,
  };
}

function makePlot(frame, names, panel, { range, readings, cursorTime, zoom, follow }) {
  const axis = { stroke: () => color("--muted"), grid: { stroke: () => color("--grid"), width: 1 }, ticks: { stroke: () => color("--grid"), width: 1 }, font: "12px system-ui, sans-serif" };
  const { min, max } = panel;
  const y = (_, low, high) => {
    if (min != null && max != null) return [min, max];
    const [from, to] = low === null ? [0, 1] : low === high ? [low - 1, high + 1] : uPlot.rangeNum(low, high, 0.1, true);
    return [min ?? from, max ?? to];
  };
  const units = [...new Set(readings.map((each) => each.unit))]; // each has a scale of its own
  const scaleOf = (unit) => `y${units.indexOf(unit)}`;
  const unitAxis = (unit, index) => ({
    ...axis,
    scale: scaleOf(unit),
    side: index ? 1 : 3,
    show: index < SHOWN_AXES,
    size: 52,
    grid: index ? { show: false } : axis.grid,
    values: (_, ticks) => ticks.map((tick) => formatNumber(tick)),
    ...(units.length > 1 && { label: unit, labelSize: 16, labelFont: axis.font }),
  });
  const options = {
    width: frame.clientWidth,
    height: HEIGHT,
    padding: [8, 12, 0, 0],
    legend: { show: false },
    cursor: { y: false, drag: { x: true, y: false, setScale: false }, points: { size: 6 }, bind: { dblclick: () => () => follow() } },
    scales: { x: { range }, ...Object.fromEntries(units.map((unit) => [scaleOf(unit), { range: y }])) },
    axes: [{ ...axis, size: 34, space: 70, values: times }, ...units.map(unitAxis)],
    series: [{}, ...names.map((name, index) => ({
      label: name,
      scale: scaleOf(readings[index].unit),
      stroke: () => color(`--curve-${index % COLORS}`),
      dash: DASHES[Math.floor(index / COLORS) % DASHES.length],
      width: 1.5,
      points: { show: false },
    }))],
    hooks: {
      setCursor: [(plot) => {
        const at = plot.cursor.idx;
        const isThere = at != null && plot.cursor.left >= 0;
        cursorTime.hidden = !isThere;
        if (isThere) setText(cursorTime, formatTime(plot.posToVal(plot.cursor.left, "x")));
        readings.forEach((reading, index) => reading.at(isThere ? (plot.data[index + 1][at] ?? null) : undefined));
      }],
      setSelect: [(plot) => {
        const { left, width } = plot.select;
        if (width < MIN_SELECTION) return;
        zoom(plot.posToVal(left, "x"), plot.posToVal(left + width, "x"));
        plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
      }],
      setScale: [(plot, key) => {
        const { min: low, max: high } = plot.scales[key];
        if (key === "x" || low == null) return;
        // A digit more than a pixel shows.
        const decimals = Math.min(6, Math.max(0, 2 - Math.floor(Math.log10(high - low || 1))));
        for (const reading of readings) if (scaleOf(reading.unit) === key) reading.scale(decimals);
      }],
    },
  };
  return new uPlot(options, [[], ...names.map(() => [])], frame);
}

function times(_, ticks, __, ___, step) {
  const parts = step < 60 ? { hour: "2-digit", minute: "2-digit", second: "2-digit" } : { hour: "2-digit", minute: "2-digit" };
  return ticks.map((tick) => new Date(tick * 1000).toLocaleTimeString(undefined, { ...parts, hour12: false }));
}
