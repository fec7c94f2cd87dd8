// Texts in the language of the reader, and numbers and times as people read them.

export const LANGUAGES = { en: "English", zh: "中文" };
const KEY = "eap-language";
let texts = {};

/** Language that the reader chose, or the browser's. */
export let language = "en";

function preferred() {
  const wanted = [stored(), ...navigator.languages].map((each) => (each ?? "").slice(0, 2));
  return wanted.find((each) => each in LANGUAGES) ?? "en";
}

function stored() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null; // a browser without storage
  }
}

/** Load the texts; with a language, keep it for the next time. */
export async function loadLanguage(chosen) {
  if (chosen) {
    try {
      localStorage.setItem(KEY, chosen);
    } catch {
      // the choice holds until the page is closed
    }
  }
  language = chosen ?? preferred();
  texts = await (await fetch(`text-${language}.json`)).json();
  document.documentElement.lang = language === "zh" ? "zh-Hans" : language;
}

/** Return a text, with `{name}` replaced by parameters. */
export function t(key, parameters = {}) {
  const text = texts[key] ?? key;
  return text.replace(/\{(\w+)\}/g, (_, name) => parameters[name] ?? "");
}

/** Return the text of a value that the server names, such as a severity; the name if there is none. */
export function tn(prefix, name) {
  return texts[`${prefix}.${name}`] ?? String(name ?? "");
}

/** Return a value of a variable as text. */
export function formatValue(value, decimals = null) {
  if (value === null || value === undefined) return "–";
  if (typeof value === "number") return formatNumber(value, decimals);
  if (typeof value === "boolean") return value ? t("on") : t("off");
  if (typeof value === "string") return value;
  return JSON.stringify(value);
}

/** Return a number with so many decimals, or with six digits that count. */
export function formatNumber(value, decimals = null) {
  if (decimals !== null) return value.toFixed(decimals);
  if (Number.isInteger(value)) return String(value);
  const text = String(Number(value.toPrecision(6)));
  return text.length < 14 ? text : value.toExponential(5);
}

/** Return a time span in microseconds in its largest fitting unit. */
export function formatDuration(us) {
  if (us === null || us === undefined) return "";
  if (us < 1000) return `${Math.round(us)} µs`;
  if (us < 1e6) return `${Math.round(us / 1000)} ms`;
  const seconds = us / 1e6;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${Math.round(seconds / 3600)} h`;
  return `${Math.round(seconds / 86400)} d`;
}

/** Return a rate, `50/s`. */
export function formatRate(perSecond) {
  if (perSecond === null || perSecond === undefined) return "–";
  return `${perSecond < 9.95 ? Number(perSecond.toFixed(1)) : Math.round(perSecond)}/s`;
}

/** Return the time of day of a Unix time, with the date unless it is today. */
export function formatTime(seconds) {
  const time = new Date(seconds * 1000);
  const clock = time.toLocaleTimeString(undefined, { hour12: false });
  return time.toDateString() === new Date().toDateString() ? clock : `${time.toLocaleDateString()} ${clock}`;
}
