// Panel `set`: an input for one variable, and what became of the value.

import { h, setAttribute, setText } from "./dom.js";
import { formatTime, formatValue, t, tn } from "./language.js";
import { describe, hrefOf, inputOf } from "./names.js";
import { staleText } from "./panel-values.js";

const ROLES = ["viewer", "operator", "engineer"];
const CONFIRM_MS = 3000;

/** Return why the user may not set a variable, empty if they may. */
function reasonDenied(panel, described, app) {
  const role = app.session?.role;
  if (app.connection.state !== "open") return t("set_offline");
  if (described && !described.settable) return t("set_not_settable", { writer: tn("writer", described.writer) });
  if (ROLES.indexOf(role) >= ROLES.indexOf(panel.for)) return "";
  const needed = t("set_needs_role", { needed: tn("role", panel.for), role: tn("role", role) });
  return app.session?.can_log_in ? `${needed} ${t("set_log_in")}` : needed;
}

/** Return the input field of a type with `value()`, `show(value)` and `check()`: why not, or empty. */
function makeField(panel, type, id) {
  const input = inputOf(type);
  const common = { id, name: "value", "aria-describedby": `${id}-hint ${id}-result` };
  if (input.kind === "bool" || input.kind === "choice") {
    const options = input.kind === "bool" ? [["false", t("off")], ["true", t("on")]]
      : input.names.map((name) => [name, name]);
    const element = h("select", common, options.map(([value, text]) => h("option", { value }, text)));
    const value = () => (input.kind === "bool" ? element.value === "true" : element.value);
    return { element, value, show: (present) => (element.value = String(present)), check: () => "" };
  }
  if (input.kind === "number") {
    const element = h("input", { ...common, type: "text", inputmode: "decimal", autocomplete: "off" });
    const value = () => Number(element.value.trim().replace(",", "."));
    const check = () => checkNumber(element.value, value(), panel, input.whole);
    return { element, value, show: (present) => (element.value = formatValue(present)), check, keys: true };
  }
  const element = h("input", { ...common, type: "text", autocomplete: "off" });
  const value = () => (input.kind === "json" ? JSON.parse(element.value) : element.value);
  const check = () => {
    try {
      value();
      return "";
    } catch {
      return t("set_not_json");
    }
  };
  return { element, value, show: (present) => (element.value = formatValue(present)), check };
}

function checkNumber(text, value, panel, whole) {
  if (!text.trim() || !Number.isFinite(value)) return t("set_not_number");
  if (whole && !Number.isInteger(value)) return t("set_not_whole");
  const { min, max } = panel;
  if ((min != null && value < min) || (max != null && value > max)) return limitsText(panel);
  return "";
}

function limitsText({ min, max }) {
  if (min != null && max != null) return t("set_between", { min, max });
  if (min != null) return t("set_at_least", { min });
  return max != null ? t("set_at_most", { max }) : "";
}

let count = 0;

/** Panel `set`. */
export function setPanel(panel, scope) {
  const { app } = scope;
  const described = describe(panel.of, app.variables);
  const isWhole = Object.hasOwn(app.variables, panel.of);
  const id = `set-${(count += 1)}`;
  const field = makeField(panel, isWhole ? described.type : "", id);
  const unit = panel.unit || described?.unit || "";
  const present = h("span", { class: "present" });
  const hint = h("p", { class: "note", id: `${id}-hint` });
  const result = h("output", { class: "result", id: `${id}-result`, role: "status" });
  const comment = h("input", { id: `${id}-comment`, maxlength: "200", autocomplete: "off", "aria-required": panel.comment === "required" ? "true" : "false" });
  const button = h("button", { type: "submit" }, t("set"));
  const step = (by) => h("button", { type: "button", class: "step", "aria-label": t(by < 0 ? "set_less" : "set_more", { step: panel.step }),
    onclick: () => move(by) }, by < 0 ? "−" : "+");
  const steps = field.keys && panel.step ? [step(-1), step(1)] : [];
  const form = h("form", { class: "set", novalidate: true },
    h("p", { class: "now" }, h("a", { class: "name", href: hrefOf("variable", panel.of) }, panel.of), " ", present),
    h("div", { class: "entry" },
      h("label", { class: "unseen", for: id }, t("set_new_value", { name: panel.title || panel.of })),
      steps[0], field.element, steps[1], h("span", { class: "unit" }, unit), button),
    panel.comment === "none" ? null : h("div", { class: "entry comment" },
      h("label", { for: `${id}-comment` }, t(panel.comment === "required" ? "set_comment_required" : "set_comment")), comment),
    hint, result);

  let isEdited = false;
  let isBusy = false;
  let expected = null;

  const tell = (text, look) => {
    setText(result, text);
    setAttribute(result, "class", `result ${look}`);
  };
  const update = () => {
    const why = reasonDenied(panel, described, app);
    for (const each of [field.element, comment, button, ...steps]) each.disabled = Boolean(why) || isBusy;
    setText(hint, why || [limitsText(panel), panel.step ? t("set_step", { step: panel.step }) : ""].filter(Boolean).join(", "));
    setAttribute(hint, "class", why ? "note denied" : "note");
  };
  const move = (by) => {
    const start = Number.isFinite(field.value()) ? field.value() : 0;
    const { min, max, step: size } = panel;
    const moved = Math.min(max ?? Infinity, Math.max(min ?? -Infinity, start + by * size));
    field.show(Number(moved.toPrecision(12)));
    isEdited = true;
  };
  const send = async () => {
    const why = field.check() || (panel.comment === "required" && !comment.value.trim() ? t("set_comment_missing") : "");
    setAttribute(field.element, "aria-invalid", Boolean(field.check()) && "true");
    if (why) {
      tell(`▲ ${why}`, "refused");
      (field.check() ? field.element : comment).focus();
      return;
    }
    const value = field.value();
    const body = comment.value.trim() && panel.comment !== "none" ? { value, comment: comment.value.trim() } : { value };
    const focused = document.activeElement;
    isBusy = true;
    update();
    tell(t("set_sending"), "");
    try {
      await app.connection.post(pathOf(panel.of), body);
      expected = { value, at: performance.now() };
      tell(t("set_sent", { value: formatValue(value), unit }), "");
      isEdited = false;
      comment.value = "";
      confirm(app.store.get(panel.of));
    } catch (error) {
      tell(`■ ${t("set_refused", { reason: error.status ? error.message : t("no_answer") })}`, "refused");
    } finally {
      isBusy = false;
      update();
      if (form.contains(focused)) focused.focus(); // a disabled element loses the focus
    }
  };
  const confirm = (shown) => {
    if (!expected) return;
    if (!shown.stale && isSame(shown.value, expected.value)) {
      tell(`✓ ${t("set_done", { value: formatValue(shown.value), unit, time: formatTime(Date.now() / 1000) })}`, "done");
      expected = null;
    } else if (performance.now() - expected.at > CONFIRM_MS) {
      tell(`▲ ${t("set_other", { value: formatValue(shown.value), unit })}`, "refused");
      expected = null;
    }
  };

  field.element.addEventListener("input", () => (isEdited = true));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    if (!isBusy) send();
  });
  form.addEventListener("keydown", (event) => {
    if (event.key === "Escape") {
      isEdited = false;
      tell("", "");
      field.show(app.store.get(panel.of).value);
    }
    const by = { ArrowUp: 1, ArrowDown: -1 }[event.key];
    if (by && steps.length && event.target === field.element) {
      event.preventDefault();
      move(by);
    }
  });
  scope.watch(panel.of, (shown) => {
    setText(present, `${formatValue(shown.value)} ${unit}${shown.stale ? ` (${staleText(shown)})` : ""}`);
    setAttribute(present, "class", shown.stale ? "present stale" : "present");
    if (!isEdited && !isBusy && document.activeElement !== field.element && !shown.stale) field.show(shown.value);
    confirm(shown);
  });
  scope.every(500, () => confirm(app.store.get(panel.of)));
  scope.on("state", update);
  update();
  return form;
}

/** Return the path of a variable in the API. */
export function pathOf(name) {
  const cut = name.indexOf("/");
  return `${encodeURIComponent(name.slice(0, cut))}/${encodeURIComponent(name.slice(cut + 1))}`;
}

function isSame(one, other) {
  if (typeof one === "number" && typeof other === "number") {
    return Math.abs(one - other) <= 1e-6 * Math.max(1, Math.abs(one)); // a REAL has 24 bits
  }
  return JSON.stringify(one) === JSON.stringify(other);
}
