// Panel `trend`: curves of variables over a window of time.

import uPlot from "./uPlot.js";
import { Curves, windowSeconds } from "./curves.js";
import { h, setAttribute, setText } from "./dom.js";
import { formatNumber, formatValue, t } from "./language.js";
import { describe, hrefOf, matchesAny, namesIn, resolve } from "./names.js";
import { pathOf } from "./panel-set.js";

const COLORS = 8;
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]];
const HEIGHT = 230;
const MIN_PERIOD_MS = 200;

const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Panel `trend`. */
export function trendPanel(panel, scope) {
  const { app } = scope;
  const names = resolve(panel.of, app.variables, app.stations);
  if (!names.length) return h("p", { class: "note" }, t("no_variables"));
  const windowS = windowSeconds(panel.window);
  const curves = new Curves(names.length, windowS);
  const position = new Map(names.map((name, index) => [name, index]));
  const plotFrame = h("div", { class: "plot", role: "img", "aria-label": t("trend_of", { names: names.join(", "), window: panel.window }) });
  const legend = h("ul", { class: "legend" });
  const readings = names.map((name, index) => legendItem(name, index, panel, scope, legend));
  const element = h("div", { class: "trend" }, plotFrame, legend);

  let plot = null;
  let isShown = false;
  let latest = Date.now() / 1000;
  let drawnAt = 0;
  const range = () => [latest - windowS, latest];
  const draw = () => {
    if (!isShown || document.hidden) return;
    drawnAt = performance.now();
    plot ??= makePlot(plotFrame, names, panel, range, readings);
    plot.setData(curves.arrays(latest));
  };
  const periodMs = Math.min(1000, Math.max(MIN_PERIOD_MS, (windowS * 1000) / 600));
  let frame = 0;
  const drawSoon = () => {
    if (frame || performance.now() - drawnAt < periodMs - 20) return;
    frame = requestAnimationFrame(() => {
      frame = 0;
      draw();
    });
  };

  scope.sample((message) => {
    let isOurs = false;
    for (const name of names) {
      const shown = message.values[name];
      if (!shown) continue;
      curves.add(message.time, position.get(name), shown[2] ? null : shown[0]);
      isOurs = true;
    }
    if (!isOurs) return;
    latest = message.time;
    drawSoon();
  });
  const load = async () => {
    const query = `?window=${encodeURIComponent(panel.window)}`;
    for (const pattern of namesIn(panel.of)) {
      if (!isKept(pattern, app)) continue;
      const found = await app.connection.get(`history/${pathOf(pattern)}${query}`).catch(() => ({}));
      for (const [name, { times, values }] of Object.entries(found)) {
        if (!position.has(name)) continue;
        times.forEach((time, index) => curves.add(time, position.get(name), values[index]));
        latest = Math.max(latest, times.at(-1) ?? 0);
      }
    }
    draw();
  };
  // Before the first message and after a gap in the connection the server knows what was.
  scope.on("state", (state) => {
    if (state === "open") load();
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
  return element;
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
  let cursor;
  let present = "";
  let isStale = false;
  const show = () => {
    setText(value, cursor === undefined ? present : formatValue(cursor));
    setAttribute(value, "class", isStale && cursor === undefined ? "number stale" : "number");
  };
  scope.watch(name, (shown) => {
    present = formatValue(shown.value) + (shown.stale ? " ?" : "");
    isStale = shown.stale;
    show();
  });
  return (at) => {
    cursor = at;
    show();
  };
}

function makePlot(frame, names, panel, range, readings) {
  const axis = { stroke: () => color("--muted"), grid: { stroke: () => color("--grid"), width: 1 }, ticks: { stroke: () => color("--grid"), width: 1 }, font: "12px system-ui, sans-serif" };
  const { min, max } = panel;
  const y = (_, low, high) => {
    if (min != null && max != null) return [min, max];
    const [from, to] = low === null ? [0, 1] : low === high ? [low - 1, high + 1] : uPlot.rangeNum(low, high, 0.1, true);
    return [min ?? from, max ?? to];
  };
  const options = {
    width: frame.clientWidth,
    height: HEIGHT,
    padding: [8, 12, 0, 0],
    legend: { show: false },
    cursor: { drag: { x: false, y: false }, points: { size: 6 } },
    scales: { x: { range }, y: { range: y } },
    axes: [{ ...axis, size: 34, space: 70, values: times }, { ...axis, size: 52, values: (_, ticks) => ticks.map((tick) => formatNumber(tick)) }],
    series: [{}, ...names.map((name, index) => ({
      label: name,
      stroke: () => color(`--curve-${index % COLORS}`),
      dash: DASHES[Math.floor(index / COLORS) % DASHES.length],
      width: 1.5,
      points: { show: false },
    }))],
    hooks: {
      setCursor: [(plot) => {
        const at = plot.cursor.idx;
        readings.forEach((read, index) => read(at == null ? undefined : (plot.data[index + 1][at] ?? undefined)));
      }],
    },
  };
  return new uPlot(options, [[], ...names.map(() => [])], frame);
}

function times(_, ticks, __, ___, step) {
  const parts = step < 60 ? { hour: "2-digit", minute: "2-digit", second: "2-digit" } : { hour: "2-digit", minute: "2-digit" };
  return ticks.map((tick) => new Date(tick * 1000).toLocaleTimeString(undefined, { ...parts, hour12: false }));
}
