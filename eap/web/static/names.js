// Names of variables, `STATION/VARIABLE`, with members, and patterns of them.

import { t } from "./language.js";

/** Return the names and patterns of a panel's `of`. */
export const namesIn = (of) => (typeof of === "string" ? [of] : of);

const escape = (text) => text.replace(/[.+?^${}()|[\]\\]/g, "\\$&");

/** Return whether a name fits a pattern, in which `*` stands for any text without slashes. */
export function matches(pattern, name) {
  if (!pattern.includes("*")) return pattern === name;
  return new RegExp(`^${pattern.split("*").map(escape).join("[^/]*")}$`).test(name);
}

/** Return whether a name fits one of the patterns of `of`. */
export const matchesAny = (of, name) => namesIn(of).some((pattern) => matches(pattern, name));

/** Return the names that fit, in the order of the patterns; without `*` a name is itself. */
export function resolve(of, variables, stations) {
  const found = new Set();
  const known = Object.keys(variables);
  for (const pattern of namesIn(of)) {
    if (!pattern.includes("*")) {
      found.add(pattern);
      continue;
    }
    for (const name of known) if (matches(pattern, name)) found.add(name);
    if (!pattern.endsWith("/state")) continue;
    for (const station of stations) if (matches(pattern, `${station}/state`)) found.add(`${station}/state`);
  }
  return [...found];
}

/** Return the variable that has a name, or whose member has it; null for none. */
export function describe(name, variables) {
  let at = name;
  while (at.includes("/")) {
    if (Object.hasOwn(variables, at)) return variables[at];
    const cut = Math.max(at.lastIndexOf("."), at.lastIndexOf("["));
    if (cut <= at.indexOf("/")) return null;
    at = at.slice(0, cut);
  }
  return null;
}

export const stationOf = (name) => name.slice(0, name.indexOf("/"));

/** Return the kind of input for a type: `bool`, `number`, `text`, or the names of an enumeration. */
export function inputOf(type) {
  if (/^(BOOL8?|BIT1?)$/.test(type)) return { kind: "bool" };
  if (/^(BIT[2-8]|U?[SDL]?INT\d*|BYTE|D?WORD|LWORD)\b(?!\[)/.test(type)) return { kind: "number", whole: true };
  if (/^L?REAL$/.test(type)) return { kind: "number", whole: false };
  const members = /^\w+<\w+:((?:\w+=-?\d+,?\s*)+)>$/.exec(type);
  if (members) return { kind: "choice", names: members[1].split(",").map((each) => each.split("=")[0].trim()) };
  const isText = /^(W?STRING\(\d+\)|WCHAR|BLOCK\(\d+\)|L?TIME|L?TOD|L?DATE|L?DT)$/.test(type);
  return { kind: isText ? "text" : "json" };
}

/** Return the name of a type without its definition. */
export const typeName = (type) => type.replace(/<.*>/s, "");

const AL_STATES = { 1: "INIT", 2: "PREOP", 3: "BOOT", 4: "SAFEOP", 8: "OP" };

/** Return the state of a variable with a state of slaves (`BUS.state`, `BUS.SLAVE.state`), or null. */
export function alState(name, value, variables) {
  const comment = variables[name]?.comment ?? "";
  return comment.includes("AL state") ? (AL_STATES[value] ?? t("slave_silent")) : null;
}

/** Return the address of a view, such as that of a variable. */
export const hrefOf = (view, name) => `#/${view}/${encodeURIComponent(name).replaceAll("%2F", "/")}`;
