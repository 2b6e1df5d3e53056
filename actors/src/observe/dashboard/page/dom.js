// DOM helpers that change only what differs.

const SVG = "http://www.w3.org/2000/svg";

export const byId = (id) => document.getElementById(id);

export function svg(tag, attributes = {}) {
  return set(document.createElementNS(SVG, tag), attributes);
}

export function set(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    const text = typeof value === "number" ? String(Math.round(value * 100) / 100) : value;
    if (element.getAttribute(name) !== text) element.setAttribute(name, text);
  }
  return element;
}

export function text(element, value) {
  if (element.textContent !== value) element.textContent = value;
}

/// Updates the children of `parent` to match `items`, in order; an element lives as long as its key.
export function keyed(parent, items, key, create, update) {
  const old = (parent.kept ??= new Map());
  const kept = new Map();
  let place = parent.firstChild;
  for (const item of items) {
    const name = key(item);
    if (kept.has(name)) continue;
    const element = old.get(name) ?? create(item);
    kept.set(name, element);
    update(element, item);
    if (element === place) place = place.nextSibling;
    else parent.insertBefore(element, place);
  }
  for (const [name, element] of old) if (!kept.has(name)) element.remove();
  parent.kept = kept;
}

/// Fills a table's body; a cell is a text or { text, class, colour, href }.
export function rows(body, items, key, cells) {
  keyed(body, items, key, () => document.createElement("tr"), (row, item) => {
    cells(item).forEach((given, index) => {
      const cell = row.cells[index] ?? row.insertCell();
      const value = typeof given === "string" ? { text: given } : given;
      if (cell.className !== (value.class ?? "")) cell.className = value.class ?? "";
      const kind = value.href ? "A" : "SPAN";
      if (value.colour === undefined && !value.href && !cell.lastElementChild) return text(cell, value.text);
      if (cell.lastElementChild?.tagName !== kind) cell.replaceChildren(swatch(), document.createElement(kind));
      cell.firstElementChild.className = value.colour === undefined ? "" : `swatch c${value.colour}`;
      if (value.href) set(cell.lastElementChild, { href: value.href });
      text(cell.lastElementChild, value.text);
    });
  });
}

function swatch() {
  const sign = document.createElement("span");
  sign.setAttribute("aria-hidden", "true");
  return sign;
}

export const n = (value) => ({ text: String(value), class: "n" });

export const counted = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;

export const percent = (share) => `${Math.round(share * 100)} %`;

/// A time span in seconds, in a readable unit.
export function span(seconds) {
  if (seconds < 0) return "0 s";
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${Math.round(seconds / 3600)} h`;
  return `${Math.round(seconds / 86400)} d`;
}

/// Age in seconds as text; below one second it is "now", so that it does not flicker.
export const ago = (seconds) => (seconds < 1 ? "now" : `${span(seconds)} ago`);

export const milliseconds = (ms) => (ms < 10 ? ms.toFixed(1) : ms < 10000 ? Math.round(ms) : (ms / 1000).toFixed(0) + "k") + " ms";

export const clock = (micros) => new Date(micros / 1000).toLocaleTimeString([], { hour12: false });
