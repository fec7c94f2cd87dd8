// Panel `plant`: stations, and arrows for the process data between them.

import { Rows, h, s, setAttribute, setText, table } from "./dom.js";
import { formatDuration, formatRate, t, tn } from "./language.js";
import { hrefOf, matchesAny } from "./names.js";
import { placeNodes, routeArrow } from "./layout.js";

const BOX = { width: 132, height: 46 };
const NARROW_BOX = { width: 106, height: 42 };
const LABELS = 14;
const NARROW = 560;
const MOST_LETTERS = 17;
const OPEN_ROWS = 12;
const RECENT_MS = 30_000;

/** Panel `plant`. */
export function graphPanel(panel, scope) {
  const svg = s("svg", { class: "graph", role: "group", "aria-label": t("graph") });
  const frame = h("div", { class: "graph-frame" }, svg);
  const flows = table(t("process_data"), [t("from"), t("pd"), t("to"), t("subscription"), t("state"),
    { text: t("rate"), number: true }, { text: t("age"), number: true }, { text: t("lost"), number: true }, { text: t("late"), number: true }, { text: t("jitter"), number: true }], { class: "flows" });
  const none = h("p", { class: "note" }, t("no_stations"));
  const details = h("details", {}, h("summary", {}, t("process_data")), flows.frame);
  const rows = new Rows(flows.body);
  const losses = new Losses();
  let drawing = null;
  let isDecided = false;
  let latest = null;
  let width = 0;

  const show = (message) => {
    latest = message;
    const links = linksOf(message, panel.of);
    losses.take(links);
    const names = nodesOf(message, links, panel.of);
    none.hidden = names.length > 0;
    frame.hidden = details.hidden = !names.length;
    if (!names.length) return;
    const shape = JSON.stringify([width, names, [...new Set(links.map((each) => each.arrow))]]);
    if (drawing?.shape !== shape && width) drawing = draw(svg, names, links, width, shape);
    if (drawing) update(drawing, message, links, losses);
    if (!isDecided && width && links.length) {
      isDecided = true;
      details.open = width < NARROW && links.length <= OPEN_ROWS; // there the arrows have no labels
    }
    rows.show(links, (each) => each.key, (each) => flowCells(each, losses));
  };
  scope.on("plant", show);
  const size = new ResizeObserver(() => {
    width = Math.floor(frame.clientWidth / 20) * 20;
    if (latest) show(latest);
  });
  size.observe(frame);
  scope.atEnd(() => size.disconnect());
  return h("div", {}, none, frame, details);
}

function linksOf(message, of) {
  const silent = new Set(message.stations.filter((each) => each.state === "no cycles").map((each) => each.name));
  const received = message.flows.filter((each) => each.direction === "rx");
  // A station without cycles keeps the state that its PDs had in the last one.
  const flows = new Map(received.map((each) => [`${each.station}/${each.name}`, silent.has(each.station) ? { ...each, state: "stale" } : each]));
  return message.links.filter((each) => matchesAny(of, each.receiver) || matchesAny(of, each.sender)).map((each) => {
    const sender = each.sender || each.publisher;
    const key = `${each.receiver}/${each.subscription}`;
    return { ...each, sender, isForeign: !each.sender, key, arrow: `${sender}→${each.receiver}`, flow: flows.get(key) };
  });
}

function nodesOf(message, links, of) {
  const known = message.stations.map((each) => each.name);
  const near = new Set(links.flatMap((each) => [each.sender, each.receiver]));
  const own = known.filter((name) => matchesAny(of, name) || near.has(name));
  return [...own, ...[...near].filter((name) => !known.includes(name))];
}

/** Losses and late PDs of links while this page shows them. */
class Losses {
  #counts = new Map();

  take(links) {
    const now = performance.now();
    for (const { key, flow } of links) {
      if (!flow) continue;
      const count = (flow.lost ?? 0) + (flow.late ?? 0);
      const before = this.#counts.get(key);
      if (!before || count < before.count) this.#counts.set(key, { count, at: -Infinity });
      else if (count > before.count) this.#counts.set(key, { count, at: now });
    }
  }

  isRecent(key) {
    return performance.now() - (this.#counts.get(key)?.at ?? -Infinity) < RECENT_MS;
  }
}

/** Return how bad the state of a link is: empty, `warn` or `alarm`. */
function severityOf({ key, flow }, losses) {
  if (!flow || flow.state === "stale") return "alarm";
  return flow.state === "waiting" || losses.isRecent(key) ? "warn" : "";
}

function flowCells(link, losses) {
  const { flow } = link;
  const severity = severityOf(link, losses);
  const sign = { alarm: "■ ", warn: "▲ " }[severity] ?? "";
  return [
    link.isForeign ? link.sender : { text: link.sender, href: hrefOf("station", link.sender) }, link.pd || String(link.id),
    { text: link.receiver, href: hrefOf("station", link.receiver) }, link.subscription,
    { text: sign + tn("pd_state", flow?.state ?? "waiting"), class: severity },
    { text: formatRate(flow?.per_s), number: true }, { text: formatDuration(flow?.age_us), number: true },
    { text: flow?.lost ?? "–", number: true }, { text: flow?.late ?? "–", number: true }, { text: formatDuration(flow?.jitter_p99_us), number: true },
  ];
}

function draw(svg, names, links, width, shape) {
  const box = width < NARROW ? NARROW_BOX : BOX;
  const arrows = new Map();
  for (const link of links) {
    if (!arrows.has(link.arrow)) arrows.set(link.arrow, { sender: link.sender, receiver: link.receiver });
  }
  const { places, height } = placeNodes(names, [...arrows.values()], width, box);
  setAttribute(svg, "viewBox", `0 0 ${width} ${height}`);
  setAttribute(svg, "height", height);
  const head = (id, className) => s("marker", { id, class: className, viewBox: "0 0 10 10", refX: "9", refY: "5", markerWidth: "7", markerHeight: "7", orient: "auto" }, s("path", { d: "M0 0L10 5L0 10z" }));
  svg.replaceChildren(s("defs", {}, head("head", "head"), head("head-warn", "head warn"), head("head-alarm", "head alarm")));
  for (const [key, arrow] of arrows) {
    const { path, x, y } = routeArrow(places.get(arrow.sender), places.get(arrow.receiver), arrows.has(`${arrow.receiver}→${arrow.sender}`), box);
    arrow.path = s("path", { d: path, class: "arrow" });
    arrow.title = s("title");
    arrow.first = s("tspan", { x, dy: "-0.1em" });
    arrow.second = s("tspan", { x, dy: "1.15em" });
    arrow.label = s("text", { class: "label", x, y }, arrow.first, arrow.second);
    arrow.plate = s("rect", { class: "plate", rx: "3" });
    arrow.group = s("g", { class: "link" }, arrow.title, s("path", { d: path, class: "reach" }), arrow.path, arrow.plate, arrow.label);
    arrow.key = key;
    svg.append(arrow.group);
  }
  const nodes = new Map();
  for (const name of names) {
    const { x, y } = places.get(name);
    const state = s("text", { x, y: y + 14, class: "state" });
    const frame = s("rect", { x: x - box.width / 2, y: y - box.height / 2, width: box.width, height: box.height, rx: 4 });
    const most = Math.floor((MOST_LETTERS * box.width) / BOX.width);
    const label = s("text", { x, y: y - 5, class: "name" }, name.length > most ? `${name.slice(0, most - 1)}…` : name);
    const group = s("a", { class: "node" }, s("title", {}, name), frame, label, state);
    nodes.set(name, { group, state });
    svg.append(group);
  }
  return { shape, arrows, nodes, hasRoom: width >= NARROW };
}

/** Lay the ground of a label under it, so that the arrow does not cross its text. */
function fitPlate({ label, plate }) {
  const { x, y, width, height } = label.getBBox();
  if (!width) return;
  for (const [name, value] of Object.entries({ x: x - 4, y: y - 1, width: width + 8, height: height + 2 })) setAttribute(plate, name, value.toFixed(1));
}

/** Return whether all slaves of a station are in OP, by the text of its buses. */
function hasWholeBuses(text) {
  const counts = [...text.matchAll(/(\d+)\/(\d+) OP/g)];
  return !/down|cut|\?/.test(text) && counts.every(([, op, all]) => op === all);
}

function update({ arrows, nodes, hasRoom }, message, links, losses) {
  const stations = new Map(message.stations.map((each) => [each.name, each]));
  for (const [name, node] of nodes) {
    const station = stations.get(name);
    const isWell = station?.state === "OP" && hasWholeBuses(station.bus);
    const text = station ? [tn("state", station.state), station.bus].filter(Boolean).join(" · ") : t("not_of_the_plant");
    setText(node.state, station && !isWell ? `▲ ${text}` : text);
    setAttribute(node.group, "class", station ? (isWell ? "node" : "node warn") : "node foreign");
    setAttribute(node.group, "href", station && hrefOf("station", name));
    setAttribute(node.group, "aria-label", `${name}: ${text}`);
  }
  for (const arrow of arrows.values()) {
    const own = links.filter((each) => each.arrow === arrow.key);
    const severities = own.map((each) => severityOf(each, losses));
    const severity = severities.includes("alarm") ? "alarm" : severities.includes("warn") ? "warn" : "";
    const sum = (field) => own.reduce((total, { flow }) => total + (flow?.[field] ?? 0), 0);
    const age = Math.max(...own.map(({ flow }) => flow?.age_us ?? 0));
    const isShown = severity || (hasRoom && arrows.size <= LABELS);
    setAttribute(arrow.group, "class", `link ${severity} ${isShown ? "labelled" : ""}`);
    setAttribute(arrow.path, "marker-end", `url(#head${severity && `-${severity}`})`);
    const worst = own.find((_, index) => severities[index] === severity && severity);
    const sign = { alarm: "■ ", warn: "▲ " }[severity] ?? "";
    setText(arrow.first, `${sign}${worst && worst.flow?.state !== "running" ? `${tn("pd_state", worst.flow?.state ?? "waiting")} ` : ""}${formatRate(sum("per_s"))} · ${formatDuration(age)}`);
    setText(arrow.second, t("arrow_lost", { lost: sum("lost"), late: sum("late") }));
    fitPlate(arrow);
    setText(arrow.title, own.map((each) => `${each.pd || each.id} → ${each.subscription}: ${formatRate(each.flow?.per_s)}, ${t("lost")} ${each.flow?.lost ?? "–"}, ${t("late")} ${each.flow?.late ?? "–"}, ${t("age")} ${formatDuration(each.flow?.age_us)}`).join("\n"));
  }
}
