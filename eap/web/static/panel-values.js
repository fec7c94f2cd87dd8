// Panels with present values: `value` and `states`.

import { h, setAttribute, setText } from "./dom.js";
import { formatDuration, formatValue, t } from "./language.js";
import { alState, describe, hrefOf, resolve, stationOf } from "./names.js";

/** Severity of a value by the limits of a panel: `alarm`, `warn` or empty. */
export function severityOf(value, { warn, alarm, warn_below: warnBelow, alarm_below: alarmBelow }) {
  if (typeof value !== "number") return "";
  const beyond = (above, below) => (above != null && value > above) || (below != null && value < below);
  if (beyond(alarm, alarmBelow)) return "alarm";
  return beyond(warn, warnBelow) ? "warn" : "";
}

/** Return the text for a stale value: since when it is no longer true. */
export function staleText({ value, age }) {
  return value === null && age === null ? t("no_data") : t("stale_for", { age: formatDuration(age) });
}

/** Panel `value`: large digits. */
export function valuePanel(panel, scope) {
  const { variables, stations } = scope.app;
  const names = resolve(panel.of, variables, stations);
  const list = h("div", { class: "values" });
  for (const name of names) list.append(valueTile(name, panel, scope, names.length > 1 || panel.title));
  if (!names.length) list.append(h("p", { class: "note" }, t("no_variables")));
  return list;
}

function valueTile(name, panel, scope, isNamed) {
  const described = describe(name, scope.app.variables);
  const number = h("span", { class: "number" });
  const note = h("span", { class: "note" });
  const unit = h("span", { class: "unit" }, panel.unit || described?.unit || "");
  const href = hrefOf("variable", name);
  const tile = h("div", { class: "tile" }, isNamed ? h("a", { class: "name", href }, name) : null,
    h("div", { class: "reading" }, number, unit), note);
  scope.watch(name, (shown) => {
    const severity = severityOf(shown.value, panel);
    setText(number, alState(name, shown.value, scope.app.variables) ?? formatValue(shown.value, panel.decimals));
    setAttribute(tile, "class", `tile ${shown.stale ? "stale" : severity}`);
    setText(note, shown.stale ? staleText(shown) : severity ? limitText(shown.value, panel, severity) : "");
  });
  return tile;
}

function limitText(value, panel, severity) {
  const above = panel[severity];
  const isAbove = above != null && value > above;
  const limit = isAbove ? above : panel[`${severity}_below`];
  return `${severity === "alarm" ? "■" : "▲"} ${t(isAbove ? "above" : "below", { limit })}`;
}

/** Panel `states`: a field for each station or variable. */
export function statesPanel(panel, scope) {
  const { variables, stations } = scope.app;
  const names = resolve(panel.of, variables, stations);
  const list = h("ul", { class: "states" });
  for (const name of names) {
    const state = h("span", { class: "state" });
    const isVariable = describe(name, variables) !== null;
    const label = isVariable ? name : stationOf(name);
    const href = hrefOf(isVariable ? "variable" : "station", label);
    const item = h("li", {}, h("a", { class: "name", href }, label), state);
    list.append(item);
    scope.watch(name, (shown) => {
      const text = alState(name, shown.value, variables) ?? formatValue(shown.value);
      const normal = typeof shown.value !== "string" || text === "OP";
      const isBad = !normal || (text !== "OP" && alState(name, shown.value, variables) !== null);
      const look = shown.stale ? "stale" : isBad ? "warn" : shown.value === true ? "active" : "";
      setText(state, shown.stale ? `${text} (${staleText(shown)})` : isBad ? `▲ ${text}` : text);
      setAttribute(item, "class", look || null);
    });
  }
  if (!names.length) return h("p", { class: "note" }, t("no_variables"));
  return list;
}
