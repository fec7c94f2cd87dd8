// Views: pages with their panels, a station, a variable, events, and the login.

import { h, setText } from "./dom.js";
import { t, tn } from "./language.js";
import { describe, hrefOf, namesIn, stationOf, typeName } from "./names.js";
import { graphPanel } from "./panel-graph.js";
import { picturePanel } from "./panel-picture.js";
import { setPanel } from "./panel-set.js";
import { busPanel, eventsPanel, findingsPanel, routesPanel, variablesPanel } from "./panel-tables.js";
import { trendPanel } from "./panel-trend.js";
import { statesPanel, valuePanel } from "./panel-values.js";

const PANELS = {
  value: valuePanel,
  trend: trendPanel,
  states: statesPanel,
  set: setPanel,
  picture: picturePanel,
  events: eventsPanel,
  findings: findingsPanel,
  bus: busPanel,
  plant: graphPanel,
  variables: variablesPanel,
  routes: routesPanel,
};

let count = 0;

/** Return the element of one panel. */
function panelElement(panel, scope, path) {
  const id = `panel-${(count += 1)}`;
  const made = PANELS[panel.kind](panel, scope, path);
  const { element, tools } = made instanceof Node ? { element: made } : made;
  const heading = h("h2", { id }, panel.title || titleOf(panel));
  const head = tools ? h("div", { class: "head" }, heading, h("div", { class: "tools" }, tools)) : heading;
  return h("section", { class: `panel panel-${panel.kind}`, "aria-labelledby": id }, head, element);
}

function titleOf({ kind, of }) {
  const names = namesIn(of ?? "");
  const isNamed = ["value", "trend", "set"].includes(kind) && names.length === 1 && !names[0].includes("*");
  return isNamed ? names[0] : t(`panel_${kind}`);
}

function panelsView(title, panels, scope, pathOf = () => "") {
  return h("div", {}, h("h1", {}, title), h("div", { class: "panels" }, panels.map((panel, position) => panelElement(panel, scope, pathOf(position)))));
}

const EVERYTHING = { title: "", of: "*" };

/** Return the view of an address: `{title, element, topics}`. */
export function makeView(address, scope) {
  const { app } = scope;
  const [kind, name] = [address.slice(0, address.indexOf("/")), address.slice(address.indexOf("/") + 1)];
  const page = app.pages.find((each) => each.name === name);
  if (kind === "page" && page) return pageView(page, scope);
  if (kind === "station" && app.stations.includes(name)) return stationView(name, scope);
  if (kind === "variable" && describe(name, app.variables)) return variableView(name, scope);
  if (kind === "events") return eventsView(scope);
  if (kind === "plant") return overview(scope);
  if (kind === "login") return loginView(scope);
  return { title: t("not_found"), topics: [], element: h("div", {}, h("h1", {}, t("not_found")), h("p", {}, t("not_found_name", { name: name || address }))) };
}

function pageView(page, scope) {
  const number = scope.app.pages.indexOf(page);
  const element = panelsView(page.name, page.panels, scope, (position) => `pictures/${number}/${position}`);
  return { title: page.name, element, topics: [`page:${page.name}`] };
}

function stationView(name, scope) {
  const panels = [
    { kind: "plant", of: name },
    { kind: "variables", of: `${name}/*` },
    { kind: "bus", of: `${name}/*` },
    { kind: "routes", of: name },
    { kind: "events", of: name, from: "info", rows: 20 },
  ];
  return { title: name, element: panelsView(name, panels, scope), topics: [`values:${name}/*`] };
}

function overview(scope) {
  const panels = [{ kind: "plant", ...EVERYTHING }, { kind: "findings" }, { kind: "states", of: "*/state" }, { kind: "bus", of: "*/*" }, { kind: "events", ...EVERYTHING, from: "info", rows: 10 }];
  return { title: t("plant"), element: panelsView(t("plant"), panels, scope), topics: ["values:*/state"] };
}

function eventsView(scope) {
  const panels = [{ kind: "findings" }, { kind: "events", ...EVERYTHING, from: "info", rows: 200 }];
  return { title: t("events"), element: panelsView(t("events"), panels, scope), topics: [] };
}

function variableView(name, scope) {
  const { app } = scope;
  const described = describe(name, app.variables);
  const configured = app.pages.flatMap((page) => page.panels).find((panel) => panel.kind === "set" && panel.of === name);
  const panels = [{ kind: "value", of: name }];
  // A variable without a panel of its own is for engineers.
  if (described.settable) panels.push(configured ?? { kind: "set", of: name, for: "engineer", comment: "optional" });
  if (/^(U?[SDL]?INT|L?REAL|BOOL|BIT|BYTE|D?WORD|LWORD)/.test(described.type) || name !== baseName(name, app)) {
    panels.push({ kind: "trend", of: name, window: "10m" });
  }
  const made = panels.map((panel) => panelElement(panel, scope, ""));
  const fact = (term, text) => (text ? [h("dt", {}, term), h("dd", {}, text)] : []);
  const about = h("section", { class: "panel panel-about" }, h("h2", {}, t("about")), h("dl", {},
    h("dt", {}, t("station")), h("dd", {}, h("a", { href: hrefOf("station", stationOf(name)) }, stationOf(name))),
    fact(t("type"), typeName(described.type)), fact(t("unit"), described.unit), fact(t("comment"), described.comment), fact(t("written_by"), tn("writer", described.writer))));
  const element = h("div", { class: "variable" }, h("h1", {}, name), h("div", { class: "panels" }, made, about));
  return { title: name, element, topics: [`values:${name}`] };
}

const baseName = (name, app) => (Object.hasOwn(app.variables, name) ? name : "");

function loginView(scope) {
  const { app } = scope;
  const result = h("p", { class: "result refused", role: "alert" });
  const user = h("input", { id: "user", autocomplete: "username", required: true, autocapitalize: "none" });
  const password = h("input", { id: "password", type: "password", autocomplete: "current-password", required: true });
  const button = h("button", { type: "submit" }, t("log_in"));
  const form = h("form", { class: "login" }, h("label", { for: "user" }, t("user")), user, h("label", { for: "password" }, t("password")), password, button, result);
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    button.disabled = true;
    setText(result, "");
    try {
      await app.connection.post("login", { user: user.value, password: password.value });
      await app.loggedIn();
    } catch (error) {
      setText(result, `■ ${error.status ? t("login_failed", { reason: error.message }) : t("no_answer")}`);
      password.value = "";
      password.focus();
    } finally {
      button.disabled = false;
    }
  });
  const { can_log_in: isPossible, role } = app.session;
  const reason = role ? t("login_none", { role: tn("role", role) }) : t("login_by_proxy");
  const element = h("div", {}, h("h1", {}, t("log_in")), h("section", { class: "panel panel-login" }, isPossible ? form : h("p", {}, reason)));
  return { title: t("log_in"), element, topics: [], focus: user };
}
