// The page: connection, header, navigation, and the view that its address names.

import { Connection } from "./connection.js";
import { h, setAttribute, setText } from "./dom.js";
import { LANGUAGES, formatTime, language, loadLanguage, t, tn } from "./language.js";
import { describe, hrefOf, stationOf } from "./names.js";
import { eventKey } from "./panel-tables.js";
import { Scope } from "./scope.js";
import { Store } from "./store.js";
import { makeView } from "./views.js";

const ANNOUNCED = 3; // of more events at once, their number is announced
const RELOAD_MS = 5000;
const byId = (id) => document.getElementById(id);

class App {
  store = new Store();
  events = new EventTarget();
  latest = {};
  pages = [];
  variables = {};
  stations = [];
  session = null;
  #scope = null;
  #shown = "";
  #isReady = false;
  #lostAt = 0;
  #announced = null;
  #directoryAt = -Infinity;
  #strange = new Set();
  #directory = "";

  constructor() {
    this.connection = new Connection({
      onState: (state) => this.#stateChanged(state),
      onSession: (session, before) => this.#sessionCame(session, before),
      onMessage: (message) => this.#messageCame(message),
    });
    addEventListener("hashchange", () => this.#show(true));
    byId("skip").addEventListener("click", (event) => {
      event.preventDefault(); // the address names the view
      byId("content").focus();
    });
  }

  async start() {
    await loadLanguage();
    this.#makeHeader();
    await this.connection.connect();
  }

  /** Go on after a login. */
  async loggedIn() {
    location.hash = "";
    await this.connection.connect();
  }

  async #logOut() {
    await this.connection.post("logout", {}).catch(() => {});
    await this.connection.connect();
  }

  async #sessionCame(session, before) {
    if (before && before.release !== session.release) location.reload(); // scripts of another release
    this.session = session;
    if (session.role) await this.#loadDirectory();
    this.#isReady = true;
    this.#makeHeader();
    this.#show(false);
  }

  async #loadDirectory() {
    const [{ pages }, variables, plant] = await Promise.all(["pages", "variables", "plant"].map((path) => this.connection.get(path)));
    this.pages = pages;
    this.variables = variables;
    this.stations = [...new Set([...plant.stations.map((each) => each.name), ...Object.keys(variables).map(stationOf)])];
    this.#strange.clear();
    const directory = JSON.stringify([pages, variables, this.stations]);
    const isOther = this.#directory !== directory;
    this.#directory = directory;
    if (isOther) this.#shown = "";
    return isOther;
  }

  /** Read pages and variables again when the server sends something unknown. */
  async #lookAgain(name) {
    if (this.#strange.has(name) || performance.now() - this.#directoryAt < RELOAD_MS) return;
    this.#directoryAt = performance.now();
    try {
      if (await this.#loadDirectory()) this.#show(false);
    } catch {
      return; // the connection notices by itself
    }
    this.#strange.add(name);
  }

  #messageCame(message) {
    if (message.type === "values") {
      this.store.take(message);
      const strange = Object.keys(message.values).find((name) => !describe(name, this.variables) && !name.endsWith("/state"));
      if (strange) this.#lookAgain(strange);
      return;
    }
    if (message.type === "plant") {
      const strange = message.stations.find((each) => !this.stations.includes(each.name));
      if (strange) this.#lookAgain(strange.name);
      this.#showPlant(message);
    }
    if (message.type === "events") this.#announce(message.events);
    this.#publish(message.type, message);
  }

  #publish(type, detail) {
    this.latest[type] = detail;
    this.events.dispatchEvent(new CustomEvent(type, { detail }));
  }

  #stateChanged(state) {
    this.store.setLive(state === "open");
    document.body.classList.toggle("offline", state === "lost");
    if (state === "lost") this.#lostAt ||= Date.now() / 1000;
    if (state === "open") this.#lostAt = 0;
    setText(byId("banner"), state === "lost" ? `▲ ${t("connection_lost", { time: formatTime(this.#lostAt) })}` : "");
    const link = byId("link");
    setText(link, tn("connection", state));
    setAttribute(link, "class", state);
    this.#publish("state", state);
    if (!this.#isReady) setText(byId("content"), state === "lost" ? t("no_answer") : t("connecting"));
  }

  #showPlant({ plant, findings, unreachable, time }) {
    setText(byId("plant"), plant || this.session.plant || "EAP");
    setText(byId("clock"), formatTime(time));
    setAttribute(byId("clock"), "data-date", new Date(time * 1000).toLocaleDateString("sv")); // on paper; as ISO 8601
    const silent = Object.entries(unreachable ?? {}).map(([name, why]) => (why.startsWith(`${name}: `) ? why : `${name}: ${why}`));
    const count = (severity) => findings.filter((each) => each.severity === severity).length;
    const [errors, warnings] = [count("error") + silent.length, count("warning")];
    const text = [errors && `■ ${t("errors")} ${errors}`, warnings && `▲ ${t("warnings")} ${warnings}`].filter(Boolean).join("  ");
    setText(byId("findings"), text || t("no_findings_short"));
    setAttribute(byId("findings"), "class", errors ? "alarm" : warnings ? "warn" : null);
    if (this.connection.state === "open") setText(byId("banner"), silent.length ? `▲ ${t("unreachable", { reasons: silent.join("; ") })}` : "");
    const sign = errors ? "■ " : warnings ? "▲ " : "";
    const title = `${sign}${this.title ? `${this.title} – ` : ""}${plant || "EAP"}`;
    if (document.title !== title) document.title = title;
  }

  #announce(events) {
    const keys = new Set(events.map(eventKey));
    const before = this.#announced;
    this.#announced = keys;
    if (!before) return;
    const fresh = events.filter((each) => !before.has(eventKey(each)) && each.severity !== "info");
    if (!fresh.length) return;
    const texts = fresh.length > ANNOUNCED ? [t("events_new", { count: fresh.length })] : fresh.map((each) => `${tn("severity", each.severity)}: ${each.where}: ${each.what}`);
    byId("announcer").replaceChildren(...texts.map((text) => h("p", {}, text)));
  }

  #makeHeader() {
    const { session } = this;
    const choice = h("select", { id: "language", "aria-label": t("language") }, Object.entries(LANGUAGES).map(([key, name]) => h("option", { value: key, selected: key === language, lang: key }, name)));
    choice.addEventListener("change", async () => {
      await loadLanguage(choice.value);
      this.#shown = "";
      this.#makeHeader();
      this.#show(false);
      byId("language").focus();
    });
    const menu = h("button", { id: "menu", type: "button", "aria-expanded": "false", "aria-controls": "nav", "aria-label": t("menu") }, "☰");
    menu.addEventListener("click", () => {
      const isOpen = document.body.classList.toggle("menu-open");
      setAttribute(menu, "aria-expanded", String(isOpen));
    });
    const who = session?.role ? h("span", { class: "who" }, session.user ? `${session.user} · ` : "", tn("role", session.role)) : null;
    const logIn = session?.can_log_in && !session.user ? h("a", { href: "#/login" }, t("log_in")) : null;
    const logOut = session?.user && session.can_log_in ? h("button", { type: "button", id: "logout", onclick: () => this.#logOut() }, t("log_out")) : null;
    byId("header").replaceChildren(menu,
      h("span", { id: "plant" }, session?.plant || "EAP"), h("span", { id: "link", role: "status" }), h("time", { id: "clock" }),
      h("a", { id: "findings", href: "#/events" }), h("span", { class: "space" }), choice, ...[who, logIn, logOut].filter(Boolean));
    setText(byId("skip"), t("skip"));
    setText(byId("link"), tn("connection", this.connection.state));
    setAttribute(byId("link"), "class", this.connection.state);
    this.#makeNavigation();
    if (this.latest.plant && session?.role) this.#showPlant(this.latest.plant);
  }

  #makeNavigation() {
    const item = (href, text) => h("li", {}, h("a", { href }, text));
    const names = this.pages.map((page) => page.name);
    const hasPlant = this.pages.some((page) => page.panels.some((panel) => panel.kind === "plant" && panel.of === "*"));
    const own = names.filter((name) => !this.stations.includes(name)); // a page with a station's name is that station's
    const list = (heading, items) => (items.length ? [h("h2", {}, heading), h("ul", {}, items)] : []);
    const parts = this.session?.role ? [
      ...list(t("pages"), [...own.map((name) => item(hrefOf("page", name), name)), ...(hasPlant ? [] : [item("#/plant/", t("plant"))]), item("#/events/", t("events"))]),
      ...list(t("stations"), this.stations.map((name) => item(hrefOf(names.includes(name) ? "page" : "station", name), name)))] : [];
    byId("nav").replaceChildren(...parts);
    setAttribute(byId("nav"), "aria-label", t("navigation"));
  }

  /** Show the view of the address, unless it is there. */
  #show(isMove) {
    if (!this.#isReady) return;
    const given = decodeURIComponent(location.hash.replace(/^#\/?/, ""));
    const first = this.pages.length ? `page/${this.pages[0].name}` : "plant/";
    const address = !this.session?.role ? "login/" : given === "login" ? "login/" : given === "events" ? "events/" : given || first;
    if (this.#shown === `${this.session?.role} ${address}`) return;
    this.#shown = `${this.session?.role} ${address}`;
    this.#makeNavigation();
    this.#scope?.end();
    this.#scope = new Scope(this);
    const view = makeView(address, this.#scope);
    this.title = view.title;
    document.title = `${view.title} – ${this.session?.plant || "EAP"}`;
    byId("content").replaceChildren(view.element);
    document.body.classList.remove("menu-open");
    setAttribute(byId("menu"), "aria-expanded", "false");
    for (const link of byId("nav").querySelectorAll("a")) {
      const isHere = link.hash === `#/${encodeURIComponent(address).replaceAll("%2F", "/")}`;
      setAttribute(link, "aria-current", isHere && "page");
    }
    this.connection.subscribe(["plant", "events", ...view.topics]);
    if (view.focus) view.focus.focus();
    else if (isMove) {
      byId("content").focus({ preventScroll: true });
      scrollTo(0, 0);
    }
  }
}

const app = new App();
app.start().catch(() => setTimeout(() => location.reload(), RELOAD_MS)); // its texts did not come
