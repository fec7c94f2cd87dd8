// Panels that are tables: `events`, `bus`, `routes`, `variables`, and the present findings.

import { Rows, h, s, setAttribute, setText, table } from "./dom.js";
import { formatDuration, formatTime, formatValue, t, tn } from "./language.js";
import { Scope } from "./scope.js";
import { alState, describe, hrefOf, matchesAny, resolve, stationOf, typeName } from "./names.js";
import { staleText } from "./panel-values.js";

const SIGNS = { error: "■", warning: "▲", info: "○" };
const LEVELS = ["info", "warning", "error"];
const MOST_ROWS = 500;

const severityCell = (severity) => ({ text: `${SIGNS[severity] ?? ""} ${tn("severity", severity)}`, class: `severity ${severity}` });

/** Panel `events`: the newest first. */
export function eventsPanel(panel, scope) {
  const { frame, body } = table(t("events"), [t("time"), t("severity"), t("where"), t("event")], { class: "events" });
  const rows = new Rows(body);
  const none = h("p", { class: "note" }, t("no_events"));
  const choice = h("select", { class: "tool", "aria-label": t("events_from") }, LEVELS.map((each) => h("option", { value: each, selected: each === panel.from }, tn("least", each))));
  let latest = [];
  const show = () => {
    const least = LEVELS.indexOf(choice.value);
    const fitting = latest.filter((each) => LEVELS.indexOf(each.severity) >= least && matchesAny(panel.of, each.where.split("/")[0]));
    const shown = fitting.slice(-panel.rows).reverse();
    none.hidden = shown.length > 0;
    frame.hidden = !shown.length;
    rows.show(shown, eventKey, (event) => [
      formatTime(event.time), severityCell(event.severity), event.where,
      event.advice ? `${event.what}; ${event.advice}` : event.what,
    ]);
  };
  choice.addEventListener("change", show);
  scope.on("events", ({ events }) => {
    latest = events;
    show();
  });
  return { element: h("div", {}, none, frame), tools: [choice] };
}

/** Return what tells one event from another. */
export const eventKey = (event) => `${event.time} ${event.where} ${event.what}`;

/** Present errors and warnings of the plant. */
export function findingsPanel(panel, scope) {
  const { frame, body } = table(t("findings"), [t("severity"), t("where"), t("finding"), t("advice")], { class: "events" });
  const rows = new Rows(body);
  const none = h("p", { class: "note" }, t("no_findings"));
  scope.on("plant", ({ findings }) => {
    const shown = findings.filter((each) => each.severity !== "info"); // those are counts
    none.hidden = shown.length > 0;
    frame.hidden = !shown.length;
    rows.show(shown, (each) => `${each.where} ${each.what}`, (each) => [severityCell(each.severity), each.where ?? "", each.what ?? "", each.advice ?? ""]);
  });
  return h("div", {}, none, frame);
}

/** Panel `bus`: slaves with their states and faults. */
export function busPanel(panel, scope) {
  const element = h("div", { class: "buses" });
  const parts = new Map();
  const none = h("p", { class: "note" }, t("no_buses"));
  element.append(none);
  scope.on("plant", ({ buses, stations }) => {
    const shown = Object.entries(buses).filter(([name]) => matchesAny(panel.of, name));
    // While no engine answers, nothing is known of the buses of a station: their text is "?".
    const silent = new Set(stations.filter((each) => each.bus.includes("?")).map((each) => each.name));
    for (const name of [...parts.keys()]) {
      if (shown.some(([each]) => each === name)) continue;
      if (silent.has(stationOf(name))) {
        parts.get(name).showSilent();
        continue;
      }
      parts.get(name).section.remove();
      parts.delete(name);
    }
    for (const [name, bus] of shown) {
      if (!parts.has(name)) parts.set(name, busPart(name, element));
      parts.get(name).show(bus);
    }
    none.hidden = parts.size > 0;
  });
  return element;
}

function busPart(name, parent) {
  const state = h("p", { class: "note" });
  const faults = h("ul", { class: "faults" });
  const { frame, body } = table(t("slaves_of", { bus: name }), [t("address"), t("slave"), t("state"), t("fault")], { class: "slaves" });
  const section = h("section", {}, h("h3", {}, h("a", { href: hrefOf("station", stationOf(name)) }, name)), state, faults, frame);
  const rows = new Rows(body);
  parent.append(section);
  const show = (bus) => {
    const present = bus.slaves.filter((slave) => !slave.is_absent);
    const inOp = present.filter((slave) => slave.state === "OP").length;
    const isCut = bus.ring?.is_whole === false;
    const facts = [
      t("slaves_in_op", { op: inOp, all: present.length }),
      bus.lost || bus.wkc_errors ? t("bus_lost", { lost: bus.lost, wkc: bus.wkc_errors }) : t("bus_none_lost"),
      bus.trip_us != null && t("bus_trip", { trip: formatDuration(bus.trip_us) }),
    ];
    setText(state, facts.filter(Boolean).join(" · "));
    const between = (bus.ring?.between ?? []).map((each) => each ?? "master").join(" – ");
    showFaults([
      !bus.is_up && t("bus_down"),
      bus.fault,
      isCut && t("ring_cut", { between }),
      ...bus.findings.map((each) => (each.advice ? `${each.what}; ${each.advice}` : each.what)),
    ].filter(Boolean));
    setAttribute(section, "class", null);
    rows.show(bus.slaves, (slave) => slave.address, (slave) => slaveCells(slave));
  };
  const showFaults = (texts) => {
    const shown = texts.map((text) => `■ ${text}`);
    if (shown.join("\n") === [...faults.children].map((each) => each.textContent).join("\n")) return;
    faults.replaceChildren(...shown.map((text) => h("li", {}, text)));
  };
  const showSilent = () => {
    showFaults([t("bus_silent")]);
    setAttribute(section, "class", "silent");
  };
  return { section, show, showSilent };
}

function slaveCells(slave) {
  const isWell = slave.is_absent || (slave.state === slave.target && !slave.fault);
  const state = slave.is_absent ? t("not_plugged_in") : (slave.state ?? t("slave_silent"));
  const target = !isWell && slave.target !== slave.state ? ` (${t("wanted", { state: slave.target })})` : "";
  return [String(slave.address), slave.name, { text: `${isWell ? "" : "▲ "}${state}${target}`, class: isWell ? "" : "warn" }, slave.fault];
}

/** Panel `routes`: AMS routes of stations, with their states. */
export function routesPanel(panel, scope) {
  const { app } = scope;
  const stations = app.stations.filter((each) => matchesAny(panel.of, each));
  const first = stations.length > 1 ? 0 : 1; // of one station its name is in the heading
  const { frame, body } = table(t("routes"), [t("station"), t("route"), t("net_id"), t("via"), t("state"), { text: t("round_trip"), number: true }, { text: t("requests"), number: true }].slice(first));
  const rows = new Rows(body);
  const note = h("p", { class: "note", role: "status" });
  const routers = new Map();
  let isEnded = false;
  const load = async () => {
    if (document.hidden || app.connection.state !== "open") return;
    let failure = "";
    for (const station of stations) {
      try {
        const found = await app.connection.get(`routes/${encodeURIComponent(station)}/`);
        routers.set(station, found.routers.filter((each) => each.station === station));
      } catch (error) {
        failure = error.message;
      }
      if (isEnded) return;
    }
    setText(note, failure ? `▲ ${failure}` : routers.size ? "" : t("no_routes"));
    const shown = [...routers.values()].flat().flatMap((router) => router.routes.map((route) => ({ station: router.station, ...route })));
    rows.show(shown, (each) => `${each.station} ${each.net_id} ${each.transport} ${each.address}`, (each) => routeCells(each).slice(first));
    frame.hidden = !shown.length;
    if (!shown.length && !failure) setText(note, t("no_routes"));
  };
  scope.atEnd(() => (isEnded = true));
  // The server limits the requests of a host; a plant of many stations is asked less often.
  scope.every(Math.max(5000, stations.length * 1000), load);
  scope.on("state", (state) => state === "open" && load());
  return h("div", {}, note, frame);
}

function routeCells(route) {
  const octets = route.net_id.split(".");
  const pattern = route.octets ? octets.map((each, index) => (index < route.octets ? each : "*")).join(".") : t("default_route");
  const isDown = route.state === "down";
  return [
    { text: route.station, href: hrefOf("station", route.station) }, route.name, pattern, `${route.transport} ${route.address}`,
    { text: `${isDown ? "▲ " : ""}${tn("route", route.state)}${route.why ? `: ${route.why}` : ""}`, class: isDown ? "warn" : "" },
    { text: formatDuration(route.rtt_us), number: true },
    { text: route.errors ? t("requests_failed", { all: route.requests, failed: route.errors }) : String(route.requests), number: true },
  ];
}

/** Panel `variables`: a table of variables with value, unit, age and the last minute. */
export function variablesPanel(panel, scope) {
  const { app } = scope;
  const names = resolve(panel.of, app.variables, app.stations).filter((name) => describe(name, app.variables));
  const isOfOne = new Set(names.map(stationOf)).size === 1; // its name is in the heading
  const { frame, body } = table(t("variables"), [t("variable"), { text: t("value"), number: true }, t("unit"), { text: t("age"), number: true }, t("last_minute"), t("type"), t("comment")], { class: "variables" });
  const filter = h("input", { type: "search", id: "filter", placeholder: t("filter_example"), autocomplete: "off" });
  const count = h("span", { class: "note", role: "status" });
  const visible = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) target.sparkline.isVisible = isIntersecting;
  });
  let rowScope = new Scope(app);
  const show = () => {
    rowScope.end();
    visible.disconnect();
    const wanted = filter.value.trim().toLowerCase().split(/\s+/);
    const fitting = names.filter((name) => {
      const text = `${name} ${describe(name, app.variables).comment}`.toLowerCase();
      return wanted.every((word) => text.includes(word));
    });
    const shown = fitting.slice(0, MOST_ROWS);
    body.replaceChildren(...shown.map((name) => variableRow(name, rowScope, sparklines, visible, isOfOne)));
    setText(count, fitting.length > shown.length
      ? t("variables_some", { shown: shown.length, all: fitting.length })
      : t("variables_count", { count: fitting.length }));
  };
  const sparklines = new Map();
  filter.addEventListener("input", show);
  scope.sample((message) => {
    for (const [name, [value, , stale]] of Object.entries(message.values)) {
      const sparkline = sparklines.get(name);
      if (sparkline) sparkline.take(message.time, stale ? null : value);
    }
  });
  scope.every(1000, () => {
    if (!document.hidden) for (const sparkline of sparklines.values()) sparkline.draw();
  });
  scope.atEnd(() => {
    rowScope.end();
    visible.disconnect();
  });
  show();
  return h("div", {}, h("p", { class: "filter" }, h("label", { for: "filter" }, t("filter")), " ", filter, " ", count), frame);
}

function variableRow(name, scope, sparklines, visible, isOfOne) {
  const { app } = scope;
  const described = describe(name, app.variables);
  const value = h("td", { class: "number" });
  const age = h("td", { class: "number" });
  const sparkline = sparklines.get(name) ?? new Sparkline();
  sparklines.set(name, sparkline);
  const row = h("tr", {},
    h("th", { scope: "row" }, h("a", { href: hrefOf("variable", name), title: name }, isOfOne ? name.slice(stationOf(name).length + 1) : name)), value, h("td", {}, described.unit), age,
    h("td", { class: "spark", "aria-hidden": "true" }, sparkline.element),
    h("td", { class: "type" }, typeName(described.type)), h("td", { class: "comment" }, described.comment));
  row.sparkline = sparkline;
  visible.observe(row);
  scope.watch(name, (shown) => {
    setText(value, alState(name, shown.value, app.variables) ?? formatValue(shown.value));
    setText(age, shown.stale ? `◷ ${shown.age === null ? t("no_data") : formatDuration(shown.age)}` : formatDuration(shown.age));
    setAttribute(row, "class", shown.stale ? "stale" : null);
    setAttribute(row, "title", shown.stale ? staleText(shown) : null);
  });
  return row;
}

/** Line of the last minute, one point a second. */
class Sparkline {
  static #WIDTH = 90;
  static #HEIGHT = 18;
  isVisible = false;
  #points = [];
  #line = s("polyline", { fill: "none", "vector-effect": "non-scaling-stroke" });
  element = s("svg", { viewBox: `0 0 ${Sparkline.#WIDTH} ${Sparkline.#HEIGHT}`, width: Sparkline.#WIDTH, height: Sparkline.#HEIGHT }, this.#line);

  take(at, value) {
    const number = typeof value === "boolean" ? Number(value) : value;
    if (typeof number !== "number" || (this.#points.length && at - this.#points.at(-1)[0] < 0.95)) return;
    this.#points.push([at, number]);
    while (at - this.#points[0][0] > 60) this.#points.shift();
  }

  draw() {
    if (!this.isVisible || this.#points.length < 2) return;
    const values = this.#points.map(([, value]) => value);
    const low = Math.min(...values);
    const span = Math.max(...values) - low;
    const end = this.#points.at(-1)[0];
    const x = (at) => (Sparkline.#WIDTH * (1 - (end - at) / 60)).toFixed(1);
    const y = (value) => (span ? Sparkline.#HEIGHT - 2 - ((Sparkline.#HEIGHT - 4) * (value - low)) / span : Sparkline.#HEIGHT / 2).toFixed(1);
    setAttribute(this.#line, "points", this.#points.map(([at, value]) => `${x(at)},${y(value)}`).join(" "));
  }
}
