// The map of the town: tiles, cells and objects in Web Mercator.

import { byId, keyed, set, svg, text, span } from "./dom.js";

const frame = byId("map");
/// Centre of the view and pixels for the width of Earth.
let view = null;
let drag = null;
let onMove = () => {};

const MIN_SCALE = 256, MAX_SCALE = 256 * 2 ** 22;
const x = (longitude) => (longitude + 180) / 360;
const y = (latitude) => 0.5 - Math.asinh(Math.tan((latitude * Math.PI) / 180)) / (2 * Math.PI);
const longitude = (at) => at * 360 - 180;
const latitude = (at) => (Math.atan(Math.sinh(Math.PI * (1 - 2 * at))) * 180) / Math.PI;

/// Calls `moved` whenever the view changes. The address keeps the view, so that it can be shared.
export function start(moved) {
  onMove = () => {
    history.replaceState(null, "", `#${bounds().map((degrees) => degrees.toFixed(5)).join(",")}`);
    moved();
  };
  byId("zoom-in").onclick = () => zoom(2);
  byId("zoom-out").onclick = () => zoom(1 / 2);
  frame.onwheel = (event) => { event.preventDefault(); zoom(2 ** (-event.deltaY / 240), event.offsetX, event.offsetY); };
  frame.onpointerdown = (event) => { drag = [event.clientX, event.clientY]; frame.setPointerCapture(event.pointerId); };
  frame.onpointermove = (event) => {
    if (!drag) return;
    move(drag[0] - event.clientX, drag[1] - event.clientY);
    drag = [event.clientX, event.clientY];
  };
  frame.onpointerup = frame.onpointercancel = () => { drag = null; };
  frame.onkeydown = (event) => {
    const steps = { ArrowLeft: [-60, 0], ArrowRight: [60, 0], ArrowUp: [0, -60], ArrowDown: [0, 60] }[event.key];
    if (steps) move(...steps);
    else if (event.key === "+") zoom(2);
    else if (event.key === "-") zoom(1 / 2);
    else if (event.key === "0") byId("fit").click();
    else return;
    event.preventDefault();
  };
  new ResizeObserver(() => view && onMove()).observe(frame);
}

/// Shows the bounds that the address has, or else these.
export function open(known) {
  const [west, south, east, north] = location.hash.slice(1).split(",").map(Number);
  if (west < east && south < north) fit({ west, south, east, north }, 1);
  else if (known) fit(known);
}

/// Shows these bounds with some room.
export function fit(bounds, share = 0.92) {
  const [width, height] = size();
  const [west, east, north, south] = [x(bounds.west), x(bounds.east), y(bounds.north), y(bounds.south)];
  const scale = Math.min(width / (east - west), height / (south - north)) * share;
  view = { x: (west + east) / 2, y: (north + south) / 2, scale: clamp(scale) };
  onMove();
}

/// The view's bounds as the API takes them; null before the first fit.
export function bounds() {
  if (!view) return null;
  const [width, height] = size().map((pixels) => pixels / 2 / view.scale);
  const north = Math.max(view.y - height, 0), south = Math.min(view.y + height, 1);
  return [longitude(Math.max(view.x - width, 0)), latitude(south), longitude(Math.min(view.x + width, 1)), latitude(north)];
}

export const hasView = () => view !== null;

const size = () => [frame.clientWidth || 600, frame.clientHeight || 400];
const clamp = (scale) => Math.min(Math.max(scale, MIN_SCALE), MAX_SCALE);

function zoom(factor, atX, atY) {
  if (!view) return;
  const [width, height] = size();
  const [dx, dy] = [(atX ?? width / 2) - width / 2, (atY ?? height / 2) - height / 2];
  const scale = clamp(view.scale * factor);
  view = { x: view.x + dx / view.scale - dx / scale, y: view.y + dy / view.scale - dy / scale, scale };
  onMove();
}

function move(dx, dy) {
  if (!view) return;
  view = { ...view, x: view.x + dx / view.scale, y: view.y + dy / view.scale };
  onMove();
}

const screen = (at) => {
  const [width, height] = size();
  return [(x(at.longitude_deg) - view.x) * view.scale + width / 2, (y(at.latitude_deg) - view.y) * view.scale + height / 2];
};

const groups = ["tiles", "objects", "cells", "names"].map((name) => frame.appendChild(svg("g", { class: name })));

/// Draws an answer of the API.
export function draw(town) {
  if (!view) return;
  const [tiles, things, cells, names] = groups;
  const box = ({ bounds }) => {
    const [left, top] = screen({ longitude_deg: bounds.west, latitude_deg: bounds.north });
    const [right, bottom] = screen({ longitude_deg: bounds.east, latitude_deg: bounds.south });
    return { x: left, y: top, width: right - left, height: bottom - top };
  };
  keyed(tiles, town.tiles, (tile) => tile.key, () => svg("rect", { class: "tile-box has-cells" }), (rect, tile) => set(rect, box(tile)));
  drawObjects(things, town.objects);
  if (town.cells.length > 0) drawCells(cells, names, town.cells);
  else drawCounts(cells, names, town.tiles, box);
}

function drawObjects(group, objects) {
  const metre = view.scale / 40075017;
  keyed(group, objects, (object) => `${object.cell} ${object.id}`, () => {
    const sign = svg("g");
    sign.append(svg("line", { class: "motion" }), svg("circle"), svg("title"));
    return sign;
  }, (sign, object) => {
    const [cx, cy] = screen(object);
    const [east, north] = object.velocity_mps ?? [0, 0];
    const pixels = metre / Math.cos((object.latitude_deg * Math.PI) / 180);
    set(sign.children[0], { x1: cx, y1: cy, x2: cx + east * pixels, y2: cy - north * pixels });
    const radius = Math.min(Math.max(2 * pixels, 1.5), 7);
    set(sign.children[1], { class: object.vehicle ? "thing car" : "thing", cx, cy, r: radius });
    text(sign.children[2], `${object.vehicle ?? object.label}, ${object.cell}, ${Math.round(object.confidence * 100)} %`);
  });
}

function drawCells(cells, names, all) {
  // Names are shown where there is room for them.
  const named = all.length <= 60 ? all : [];
  const key = (cell) => `${cell.tile} ${cell.cell}`;
  const places = spread(all, key);
  keyed(cells, all, key, (cell) => {
    const sign = svg("circle", { r: 7 });
    sign.append(svg("title"));
    sign.onclick = () => { if (sign.page) window.open(`http://${sign.page}/`, "_blank", "noopener"); };
    return sign;
  }, (sign, cell) => {
    const [cx, cy] = places.get(key(cell));
    sign.page = cell.page;
    set(sign, { class: `cell ${cell.state}${cell.troubles.length ? " troubled" : ""}`, cx, cy });
    const state = cell.state === "told" ? "leading" : cell.state;
    const age = cell.age_s === null ? "" : `, map ${span(cell.age_s)} old`;
    const page = cell.page ? `, page at ${cell.page}` : "";
    text(sign.firstChild, `${cell.cell}: ${state}, ${cell.leader ? `led by ${cell.leader}` : "no leader"}${age}${page}`);
  });
  keyed(names, named, key, () => svg("text"), (label, cell) => {
    const [cx, cy] = places.get(key(cell));
    set(label, { class: "", x: cx + 11, y: cy + 4 });
    text(label, cell.cell);
  });
}

/// Places on the screen; cells of one place stand side by side.
function spread(all, key) {
  const taken = new Map();
  return new Map(all.map((cell) => {
    const [cx, cy] = screen(cell);
    const place = `${Math.round(cx)} ${Math.round(cy)}`;
    const before = taken.get(place) ?? 0;
    taken.set(place, before + 1);
    return [key(cell), [cx, cy + 18 * before]];
  }));
}

function drawCounts(cells, names, tiles, box) {
  const middle = (tile) => { const { x, y, width, height } = box(tile); return [x + width / 2, y + height / 2, width]; };
  const most = ({ totals }) => ["live", "told", "silent", "offline"].reduce((a, b) => (totals[b] > totals[a] ? b : a));
  const worst = ({ totals }) => (totals.offline > 0 ? " some-offline" : totals.silent > 0 ? " some-silent" : "");
  keyed(cells, tiles, (tile) => tile.key, (tile) => {
    const sign = svg("circle");
    sign.append(svg("title"));
    sign.onclick = () => fit(sign.bounds);
    return sign;
  }, (sign, tile) => {
    const [cx, cy, width] = middle(tile);
    sign.bounds = tile.bounds;
    const radius = Math.min(6 + 3 * Math.sqrt(tile.totals.cells), Math.max(width * 0.46, 3));
    set(sign, { class: `cell tile-count ${most(tile)}${worst(tile)}`, cx, cy, r: radius });
    const { cells, live, told, silent, offline } = tile.totals;
    text(sign.firstChild, `${cells} cells: ${live} live, ${told} leading, ${silent} silent, ${offline} offline`);
  });
  const wide = tiles.filter((tile) => middle(tile)[2] > 26);
  keyed(names, wide, (tile) => tile.key, () => svg("text"), (label, tile) => {
    const [cx, cy] = middle(tile);
    set(label, { class: "count", x: cx, y: cy + 4 });
    text(label, String(tile.totals.cells));
  });
}
