// Small line charts over time, newest values at the right edge.

import { clock, keyed, set, svg, text } from "./dom.js";

const SPAN_US = 600e6;
const PAD = { left: 34, right: 8, top: 8, bottom: 18 };

/// Draws lines of [time, value | null] pairs; `names` reserves room for names at the right.
export function chart(frame, { lines, now, floor = 0, ceiling = null, names = false, unit = "", label }) {
  const picture = frame.firstElementChild ?? frame.appendChild(svg("svg", { role: "img" }));
  const { width, height } = frame.getBoundingClientRect();
  if (width < 40) return;
  set(picture, { viewBox: `0 0 ${Math.round(width)} ${Math.round(height)}`, "aria-label": label });
  const values = lines.flatMap((line) => line.points.map(([, value]) => value)).filter((value) => value !== null);
  const top = ceiling ?? nice(Math.max(floor + 1e-3, ...values));
  const right = width - PAD.right - (names ? 76 : 0);
  const first = Math.min(now - 60e6, ...lines.flatMap((line) => line.points.slice(0, 1).map(([at]) => at)));
  const start = Math.max(first, now - SPAN_US);
  const x = (at) => PAD.left + ((at - start) / (now - start)) * (right - PAD.left);
  const y = (value) => height - PAD.bottom - ((value - floor) / (top - floor)) * (height - PAD.bottom - PAD.top);

  const levels = [floor, (floor + top) / 2, top];
  keyed(group(picture, "axes"), levels.map((level, index) => ({ level, index })), (tick) => tick.index, axis, (g, { level }) => {
    set(g.firstChild, { x1: PAD.left, x2: right, y1: y(level), y2: y(level) });
    set(g.lastChild, { x: PAD.left - 6, y: y(level) + 4, "text-anchor": "end" });
    text(g.lastChild, trim(level) + (level === top ? unit : ""));
  });
  const ends = [[start, `${Math.max(1, Math.round((now - start) / 60e6))} min earlier`, "start"], [now, clock(now), "end"]];
  keyed(group(picture, "times"), ends, (end) => end[2], () => svg("text"), (element, [at, name, anchor]) => {
    set(element, { x: x(at), y: height - 3, "text-anchor": anchor });
    text(element, name);
  });
  keyed(group(picture, "lines"), lines, (line) => line.name, () => svg("path"), (path, line) => {
    set(path, { class: `${line.class} c${line.colour}`, d: trace(line.points.filter(([at]) => at >= start), x, y) });
  });
  keyed(group(picture, "names"), names ? spread(lines, y, height) : [], (name) => name.name, () => svg("text"), (element, name) => {
    set(element, { class: `name c${name.colour}`, x: right + 8, y: name.y + 4 });
    text(element, name.name.length > 10 ? name.name.slice(0, 9) + "…" : name.name);
  });
}

function group(parent, name) {
  parent.groups ??= {};
  return (parent.groups[name] ??= parent.appendChild(svg("g")));
}

function axis() {
  const g = svg("g");
  g.append(svg("line", { class: "axis" }), svg("text"));
  return g;
}

/// Path of a line; null values are gaps.
function trace(points, x, y) {
  let pen = "M";
  let path = "";
  for (const [at, value] of points) {
    if (value === null) pen = "M";
    else {
      path += `${pen}${x(at).toFixed(1)} ${y(value).toFixed(1)}`;
      pen = "L";
    }
  }
  return path;
}

/// Names beside the ends of their lines, without overlap; the table has those without room.
function spread(lines, y, height) {
  const named = lines.filter((line) => line.points.at(-1)?.[1] != null).map((line) => ({ ...line, y: y(line.points.at(-1)[1]) }));
  named.sort((a, b) => a.y - b.y);
  const room = Math.floor((height - PAD.bottom) / 14);
  const shown = named.slice(0, room);
  shown.forEach((name, i) => (name.y = Math.max(name.y, i ? shown[i - 1].y + 14 : 6)));
  for (let i = shown.length - 1; i >= 0; i--) shown[i].y = Math.min(shown[i].y, i === shown.length - 1 ? height - PAD.bottom : shown[i + 1].y - 14);
  return shown;
}

/// The next round number.
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 4, 5, 10, 20].find((step) => step * power >= value * 1.02) * power;
}

const trim = (value) => (value >= 10 ? value.toFixed(0) : value.toFixed(value < 1 ? 2 : 1)).replace(/\.?0+$/, (end) => (end.includes(".") ? "" : end));
