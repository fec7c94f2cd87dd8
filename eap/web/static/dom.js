// Elements, and lists of them that change in place.

const SVG = "http://www.w3.org/2000/svg";

function fill(element, properties, children) {
  for (const [name, value] of Object.entries(properties ?? {})) {
    if (value === undefined || value === null || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

/** Return an HTML element; properties with `on…` are listeners, all others are attributes. */
export function h(tag, properties, ...children) {
  return fill(document.createElement(tag), properties, children);
}

/** Return an SVG element. */
export function s(tag, properties, ...children) {
  return fill(document.createElementNS(SVG, tag), properties, children);
}

/** Set the text of an element, if it is another one: unchanged text costs the browser nothing. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Set or remove an attribute, if it is another one. */
export function setAttribute(element, name, value) {
  if (value === null || value === undefined || value === false) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else {
    const text = value === true ? "" : String(value);
    if (element.getAttribute(name) !== text) element.setAttribute(name, text);
  }
}

/** Return a table with a caption for screen readers, and its columns' headings. */
export function table(caption, headings, properties) {
  const body = h("tbody");
  const row = h("tr", {}, headings.map((each) => heading(each)));
  const element = h("table", properties, h("caption", { class: "unseen" }, caption), h("thead", {}, row), body);
  const frame = h("div", { class: "scrolled", tabindex: "0", role: "region", "aria-label": caption }, element);
  return { frame, body };
}

function heading(each) {
  const { text, number } = typeof each === "string" ? { text: each } : each;
  return h("th", { scope: "col", class: number && "number" }, text);
}

/** Rows of a table, kept by key and changed in place.
 *
 *  A cell is a text or `{text, class, href, title, number}`; the first one is the row's heading.
 */
export class Rows {
  #rows = new Map();

  constructor(body) {
    this.body = body;
  }

  show(items, keyOf, cellsOf, classOf) {
    const old = this.#rows;
    this.#rows = new Map();
    let at = this.body.firstElementChild;
    for (const item of items) {
      const key = keyOf(item);
      if (this.#rows.has(key)) continue;
      const cells = cellsOf(item);
      const row = old.get(key) ?? this.#make(cells);
      old.delete(key);
      this.#rows.set(key, row);
      cells.forEach((cell, position) => fillCell(row.children[position], cell));
      setAttribute(row, "class", (classOf && classOf(item)) || null);
      if (row === at) at = at.nextElementSibling;
      else this.body.insertBefore(row, at);
    }
    for (const row of old.values()) row.remove();
  }

  #make(cells) {
    return h("tr", {}, cells.map((_, position) => (position ? h("td") : h("th", { scope: "row" }))));
  }
}

function fillCell(element, cell) {
  const given = cell !== null && typeof cell === "object" ? cell : { text: cell };
  const text = given.text === null || given.text === undefined ? "" : String(given.text);
  if (given.href) {
    const link = element.firstElementChild ?? element.appendChild(h("a"));
    setAttribute(link, "href", given.href);
    setText(link, text);
  } else {
    setText(element, text);
  }
  setAttribute(element, "class", [given.number && "number", given.class].filter(Boolean).join(" ") || null);
  setAttribute(element, "title", given.title || null);
}
