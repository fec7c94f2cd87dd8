// Panel `picture`: an SVG whose elements follow variables.

import { h, setAttribute, setText } from "./dom.js";
import { formatValue, t } from "./language.js";
import { describe } from "./names.js";
import { severityOf, staleText } from "./panel-values.js";

const LOOKS = { alarm: "#d0021b", warn: "#f5b800", on: "#2f6fb3", off: "#9aa3ab" };

/** Panel `picture`; *path* is that of its file in the API. */
export function picturePanel(panel, scope, path) {
  const { app } = scope;
  // A tree of its own: the IDs of two pictures do not meet.
  const host = h("div", { class: "picture", role: "img", "aria-label": panel.title || t("picture") });
  const root = host.attachShadow({ mode: "open" });
  const values = h("ul", { class: "unseen" });
  const note = h("p", { class: "note", role: "status" });
  const stale = new Map();
  load();
  return h("div", {}, host, note, values);

  async function load() {
    let text;
    try {
      const response = await fetch(`api/v1/${path}`);
      text = await response.text();
      if (!response.ok) throw new Error(JSON.parse(text).error.message);
    } catch (error) {
      setText(note, `▲ ${t("picture_missing", { reason: error.message })}`);
      return;
    }
    const svg = document.importNode(new DOMParser().parseFromString(text, "image/svg+xml").documentElement, true);
    if (!svg.getAttribute("viewBox") && svg.getAttribute("width")) {
      svg.setAttribute("viewBox", `0 0 ${parseFloat(svg.getAttribute("width"))} ${parseFloat(svg.getAttribute("height"))}`);
    }
    svg.setAttribute("width", "100%");
    svg.removeAttribute("height");
    root.append(svg);
    for (const [selector, bound] of Object.entries(panel.bind)) bind(selector, bound);
  }

  function bind(selector, bound) {
    const element = root.querySelector(`#${CSS.escape(selector.replace(/^#/, ""))}`);
    if (!element) return;
    const unit = describe(bound.of, app.variables)?.unit ?? "";
    const show = makeShow(element, bound, unit);
    const reading = values.appendChild(h("li"));
    const original = element.getAttribute("opacity");
    scope.watch(bound.of, (shown) => {
      show(shown.value, shown.stale);
      if (shown.stale) element.setAttribute("opacity", "0.4");
      else if (original === null) element.removeAttribute("opacity");
      else element.setAttribute("opacity", original);
      setText(reading, `${bound.of}: ${formatValue(shown.value)} ${unit} ${shown.stale ? staleText(shown) : ""}`);
      if (shown.stale) stale.set(bound.of, staleText(shown));
      else stale.delete(bound.of);
      setText(note, stale.size ? `◷ ${[...stale].map(([name, age]) => `${name} ${age}`).join(", ")}` : "");
    });
  }
}

/** Return the function that shows a value by an element. */
function makeShow(element, bound, unit) {
  const isText = element.localName === "text" || element.localName === "tspan";
  const kind = bound.show === "auto" ? (isText ? "text" : "color") : bound.show;
  if (kind === "text") {
    const target = isText ? element : (element.querySelector("text, tspan") ?? element);
    const place = target.querySelector("tspan") ?? target;
    return (value, stale) => setText(place, `${formatValue(value)}${unit ? ` ${unit}` : ""}${stale ? " ?" : ""}`);
  }
  if (kind === "visible") return (value) => element.setAttribute("visibility", value ? "visible" : "hidden");
  if (kind === "color") {
    const shapes = [element, ...element.querySelectorAll("*")].filter((each) => each === element || each.hasAttribute("fill"));
    const painted = shapes.filter((each) => each.getAttribute("fill") !== "none").map((each) => [each, each.getAttribute("fill")]);
    const hasLimits = bound.warn != null || bound.alarm != null;
    return (value) => {
      const look = severityOf(value, bound) || (hasLimits ? "" : value ? "on" : "off");
      for (const [shape, own] of painted) setAttribute(shape, "fill", LOOKS[look] ?? own);
    };
  }
  // The box is known only while the element is drawn; a transformation of its own must not count.
  const transform = element.getAttribute("transform") ?? "";
  const fraction = (value) => Math.min(1, Math.max(0, (Number(value ?? 0) - bound.min) / (bound.max - bound.min || 1)));
  return (value) => {
    const box = element.getBBox();
    const change = kind === "level"
      ? `translate(0 ${box.y + box.height}) scale(1 ${fraction(value)}) translate(0 ${-box.y - box.height})`
      : `rotate(${Number(value ?? 0)} ${box.x + box.width / 2} ${box.y + box.height / 2})`;
    element.setAttribute("transform", `${transform} ${change}`);
  };
}
