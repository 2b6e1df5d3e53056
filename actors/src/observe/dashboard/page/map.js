// Bird's-eye view: world metres to screen pixels, symbols of constant size, labels that do not overlap.

import { reasons } from "./scene.js";
import { ago, byId, keyed, set, span, svg, text } from "./dom.js";

/// Standard deviations of the 95 % error ellipse in two dimensions: the square root of the χ² quantile.
const SIGMAS_95 = 2.4477;
/// Maximum number of drawn places, and of objects; the table has all.
const MAX_DRAWN = 2000;
/// Age in seconds from which silent vehicles and unseen objects are drawn pale with their age.
const OLD_S = 2;
const MARGIN_PX = 56;
/// Maximum pixels per metre without zoom.
const MAX_SCALE = 4000;
/// Time for which half of the map must have been enough before it is fitted again.
const ROOMY_MS = 5000;

export class BirdsEye {
  #picture = byId("map");
  #layers = {};
  #bounds = null;
  #fullAt = 0;
  #zoom = 1;
  #shift = [0, 0];
  /// Whether a table is shown in the place of the map.
  asTable = false;
  /// Name of the symbol that is pointed at, here or elsewhere: its kind and identity.
  lit = null;

  /// Calls `onLight` with the name of the symbol that is pointed at, or null.
  constructor(redraw, onLight = () => {}) {
    Object.assign(this, { redraw, onLight });
    for (const name of ["grid", "views", "places", "dots", "objects", "vehicles", "labels", "scale"]) {
      this.#layers[name] = this.#picture.appendChild(svg("g"));
    }
    byId("zoom-in").onclick = () => this.#zoomBy(1.4);
    byId("zoom-out").onclick = () => this.#zoomBy(1 / 1.4);
    byId("fit").onclick = () => this.#fit();
    byId("as-table").onclick = ({ target }) => {
      this.asTable = !this.asTable;
      byId("map-table").hidden = !this.asTable;
      byId("map-frame").hidden = this.asTable;
      target.setAttribute("aria-pressed", String(this.asTable));
      redraw();
    };
    this.#picture.addEventListener("keydown", (event) => this.#key(event));
    this.#picture.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.#zoomBy(event.deltaY < 0 ? 1.15 : 1 / 1.15);
    }, { passive: false });
    this.#drag();
    new ResizeObserver(redraw).observe(this.#picture);
  }

  /// Draws { places, objects, vehicles, now }.
  draw(scene) {
    const box = this.#picture.getBoundingClientRect();
    const empty = scene.places.length + scene.objects.length + scene.vehicles.length === 0;
    byId("map-empty").hidden = !empty;
    if (Math.min(box.width, box.height) <= 2 * MARGIN_PX || empty) return;
    set(this.#picture, { viewBox: `0 0 ${Math.round(box.width)} ${Math.round(box.height)}`, "aria-label": describe(scene) });
    this.#picture.classList.toggle("zoomed", this.#zoom !== 1);
    const at = this.#projection(scene, box);
    const labels = new Labels(box);
    this.#grid(at, box);
    this.#places(scene.places.slice(0, MAX_DRAWN), at, labels);
    this.#objects(scene.objects.slice(0, MAX_DRAWN), at, labels);
    this.#vehicles(scene.vehicles, scene.now, at, labels);
    keyed(this.#layers.labels, labels.placed, (label) => label.key, () => svg("text"), (element, label) => {
      set(element, { x: label.x, y: label.y, "text-anchor": label.anchor, class: label.class });
      text(element, label.text);
    });
  }

  #projection(scene, box) {
    this.#takeIn(scene, box);
    const [left, bottom, right, top] = this.#bounds;
    const scale = fitting(this.#bounds, box) * this.#zoom;
    const [cx, cy] = [box.width / 2 + this.#shift[0], box.height / 2 + this.#shift[1]];
    const at = (p) => [cx + (p.x_m - (left + right) / 2) * scale, cy - (p.y_m - (bottom + top) / 2) * scale];
    return Object.assign(at, { scale });
  }

  /// Bounds grow at once and shrink late, so that the map stays steady while vehicles come and go, and recovers from a
  /// wrong position. Moved or zoomed by hand, the map keeps its bounds until Fit.
  #takeIn(scene, box) {
    const moved = this.#zoom !== 1 || this.#shift.some((shift) => shift !== 0);
    if (this.#bounds && moved) return;
    const now = performance.now();
    const needed = bounds(scene);
    const grown = union(this.#bounds ?? needed, needed);
    if (fitting(needed, box) < 2 * fitting(grown, box)) this.#fullAt = now;
    this.#bounds = now - this.#fullAt > ROOMY_MS ? needed : grown;
  }

  #grid(at, box) {
    const step = [1, 2, 5, 10].map((n) => n * 10 ** Math.floor(Math.log10(80 / at.scale))).find((n) => n * at.scale >= 70);
    const [zeroX, zeroY] = at({ x_m: 0, y_m: 0 });
    const lines = [];
    const px = step * at.scale;
    for (let x = ((zeroX % px) + px) % px; x < box.width; x += px) lines.push({ x1: x, x2: x, y1: 0, y2: box.height });
    for (let y = ((zeroY % px) + px) % px; y < box.height; y += px) lines.push({ x1: 0, x2: box.width, y1: y, y2: y });
    keyed(this.#layers.grid, lines.map((line, index) => ({ line, index })), (l) => l.index, () => svg("line", { class: "grid" }), (element, l) => set(element, l.line));
    keyed(this.#layers.scale, [0], () => 0, () => {
      const g = svg("g");
      g.append(svg("path", { class: "rule" }), svg("text", { class: "scale dim" }));
      return g;
    }, (g) => {
      const y = box.height - 12;
      set(g.firstChild, { d: `M12 ${y - 5}v5h${px.toFixed(1)}v-5` });
      set(g.lastChild, { x: 18 + px, y });
      text(g.lastChild, step >= 1 ? `${step} m` : `${+(step * 100).toFixed(1)} cm`);
    });
  }

  #places(places, at, labels) {
    keyed(this.#layers.places, places, (place) => place.id, () => {
      const g = svg("g");
      g.append(svg("line", { class: "facing" }), svg("rect", { width: 11, height: 11, rx: 3 }), svg("title"));
      return g;
    }, (g, place) => {
      const [x, y] = at(place);
      const [line, sign, title] = g.children;
      set(g, { class: this.#light(g, `place ${place.id}`) });
      const facing = place.facing_rad ?? null;
      const reach = facing === null ? 0 : 13;
      set(line, { x1: x, y1: y, x2: x + reach * Math.cos(facing ?? 0), y2: y - reach * Math.sin(facing ?? 0) });
      set(sign, { x: x - 5.5, y: y - 5.5, class: `place ${place.state}` });
      text(title, [`${place.id}: ${place.label ?? place.words}`, reasons(place)].filter(Boolean).join(", "));
      labels.put(`place ${place.id}`, place.label ?? place.id, x, y, 9, place.label ? "" : "dim");
    });
  }

  #objects(objects, at, labels) {
    keyed(this.#layers.objects, objects, (object) => object.id, () => {
      const g = svg("g");
      g.append(svg("line", { class: "motion" }), svg("ellipse", { class: "ellipse" }), svg("circle", { class: "centre", r: 2.5 }), svg("title"));
      return g;
    }, (g, object) => {
      const [x, y] = at(object);
      const { a, b, turn } = ellipse(object.covariance_m2);
      const [motion, around, centre, title] = g.children;
      const [east, north] = object.velocity_mps ?? [0, 0];
      const [x2, y2] = at({ x_m: object.x_m + east, y_m: object.y_m + north });
      set(motion, { x1: x, y1: y, x2, y2 });
      const degrees = ((-turn * 180) / Math.PI).toFixed(1);
      set(around, { rx: Math.max(a * at.scale, 5), ry: Math.max(b * at.scale, 5), transform: `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${degrees})` });
      set(centre, { cx: x, cy: y });
      const age = object.age_s ?? 0;
      set(g, { class: `${age > OLD_S ? "old" : ""} ${this.#light(g, `object ${object.id}`)}`.trim() });
      text(title, `${object.label}, ${Math.round(object.confidence * 100)} %, ± ${a.toFixed(2)} m, seen ${ago(age)} by ${object.contributors.join(", ")}`);
      labels.put(`object ${object.id}`, aged(object.vehicle ?? object.label, age), x, y, 9, age > OLD_S ? "old" : "");
    });
  }

  /// Class of a symbol, which says when it is pointed at.
  #light(symbol, name) {
    symbol.onpointerenter = () => this.onLight(name);
    symbol.onpointerleave = () => this.onLight(null);
    return this.lit === name ? "lit" : "";
  }

  #vehicles(vehicles, now, at, labels) {
    const posed = vehicles.filter((vehicle) => vehicle.pose);
    const old = (vehicle) => ((now - vehicle.received_at_us) / 1e6 > OLD_S ? "old" : "");
    keyed(this.#layers.views, posed, (v) => v.node, () => svg("path"), (path, v) => {
      set(path, { class: `view c${v.colour} ${old(v)}`, d: wedge(v, at) });
    });
    const dots = vehicles.flatMap((v) => v.objects.map((object, index) => ({ ...object, key: `${v.node} ${index}`, of: v })));
    keyed(this.#layers.dots, dots.slice(0, MAX_DRAWN), (dot) => dot.key, () => svg("circle", { r: 3.5 }), (circle, dot) => {
      const [cx, cy] = at(dot);
      set(circle, { cx, cy, class: `dot c${dot.of.colour} ${old(dot.of)}` });
    });
    keyed(this.#layers.vehicles, posed, (v) => v.node, () => {
      const g = svg("g");
      g.append(svg("path", { class: "body", d: "M12 0L-8 7.5L-4 0L-8 -7.5Z" }), svg("title"));
      return g;
    }, (g, v) => {
      const [x, y] = at(v.pose);
      const degrees = ((-v.pose.heading_rad * 180) / Math.PI).toFixed(1);
      set(g, { class: `c${v.colour} ${old(v)}` });
      set(g.firstChild, { transform: `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${degrees})` });
      const age = (now - v.received_at_us) / 1e6;
      text(g.lastChild, `${v.node}, report ${span(age)} old`);
      labels.put(`vehicle ${v.node}`, aged(v.node, age), x, y, 14, `vehicle c${v.colour} ${old(v)}`);
    });
  }

  #zoomBy(factor) {
    const zoom = Math.min(Math.max(this.#zoom * factor, 0.2), 60);
    this.#shift = this.#shift.map((shift) => (shift * zoom) / this.#zoom);
    this.#zoom = zoom;
    this.redraw();
  }

  #fit() {
    [this.#zoom, this.#shift, this.#bounds] = [1, [0, 0], null];
    this.redraw();
  }

  #key(event) {
    const move = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] }[event.key];
    if (move) this.#shift = [this.#shift[0] + move[0], this.#shift[1] + move[1]];
    else if (event.key === "+" || event.key === "=") return this.#zoomBy(1.4);
    else if (event.key === "-") return this.#zoomBy(1 / 1.4);
    else if (event.key === "0") return this.#fit();
    else return;
    event.preventDefault();
    this.redraw();
  }

  /// Touch scrolls the page until the map is zoomed, then moves the map.
  #drag() {
    let last = null;
    this.#picture.addEventListener("pointerdown", (event) => {
      if (!event.isPrimary || (event.pointerType === "touch" && this.#zoom === 1)) return;
      last = [event.clientX, event.clientY];
      this.#picture.setPointerCapture(event.pointerId);
      this.#picture.classList.add("dragging");
    });
    this.#picture.addEventListener("pointermove", (event) => {
      if (!last || !event.isPrimary) return;
      this.#shift = [this.#shift[0] + event.clientX - last[0], this.#shift[1] + event.clientY - last[1]];
      last = [event.clientX, event.clientY];
      this.redraw();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      this.#picture.addEventListener(end, () => {
        last = null;
        this.#picture.classList.remove("dragging");
      });
    }
  }
}

/// Bounds of places, objects and vehicles: west, south, east, north. Vehicles that see nothing of them, and raw detections,
/// which are less certain, count only where there is little else.
function bounds({ places, objects, vehicles }) {
  const looking = vehicles.filter((v) => v.objects.length + v.seen.length > 0);
  const sure = [...places, ...objects, ...looking.map((v) => v.pose)].filter(Boolean);
  const points = sure.length > 1 ? sure : [...sure, ...vehicles.map((v) => v.pose).filter(Boolean), ...vehicles.flatMap((v) => v.objects)];
  return points.length > 0 ? points.map((p) => [p.x_m, p.y_m, p.x_m, p.y_m]).reduce((a, b) => union(a, b)) : [0, 0, 0, 0];
}

const union = (a, b) => [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[2], b[2]), Math.max(a[3], b[3])];

/// Pixels per metre with which the bounds fill the box.
function fitting([left, bottom, right, top], box) {
  const fill = (pixels, metres) => (pixels - 2 * MARGIN_PX) / Math.max(metres, 1e-3);
  return Math.min(fill(box.width, right - left), fill(box.height, top - bottom), MAX_SCALE);
}

/// Half axes of the 95 % ellipse in metres, and the direction of the longer one.
function ellipse([xx, xy, yy]) {
  const mean = (xx + yy) / 2;
  const spread = Math.hypot((xx - yy) / 2, xy);
  return { a: SIGMAS_95 * Math.sqrt(mean + spread), b: SIGMAS_95 * Math.sqrt(Math.max(mean - spread, 0)), turn: Math.atan2(2 * xy, xx - yy) / 2 };
}

/// Field of view of a vehicle; estimated from its detections if it reports none.
function wedge(vehicle, at) {
  const { pose, view, objects, seen } = vehicle;
  const rays = [...objects, ...seen].map((p) => [Math.hypot(p.x_m - pose.x_m, p.y_m - pose.y_m), turn(Math.atan2(p.y_m - pose.y_m, p.x_m - pose.x_m) - pose.heading_rad)]);
  const reach = view?.range_m ?? Math.max(rays.reduce((far, [range]) => Math.max(far, range), 0) * 1.1, 60 / at.scale);
  const half = view ? Math.min(view.angle_rad / 2, 3.14) : rays.reduce((wide, [, bearing]) => Math.max(wide, Math.abs(bearing)), 0) + 0.05;
  const point = (bearing) => at({ x_m: pose.x_m + reach * Math.cos(pose.heading_rad + bearing), y_m: pose.y_m + reach * Math.sin(pose.heading_rad + bearing) }).map((c) => c.toFixed(1)).join(" ");
  const r = (reach * at.scale).toFixed(1);
  const [x, y] = at(pose).map((c) => c.toFixed(1));
  return `M${x} ${y}L${point(-half)}A${r} ${r} 0 ${half > Math.PI / 2 ? 1 : 0} 0 ${point(half)}Z`;
}

/// A name, with its age if that is high.
const aged = (name, age) => (age > OLD_S ? `${name}, ${span(age)}` : name);

const turn = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

/// Description of the map for screen readers.
function describe({ places, objects, vehicles }) {
  const labelled = places.filter((place) => place.label).length;
  return `Map of ${places.length} places, ${labelled} with a label, ${objects.length} other objects and ${vehicles.length} vehicles`;
}

/// Places labels beside their symbols without overlap; a label without room is omitted.
class Labels {
  placed = [];
  #taken = [];

  constructor(box) {
    this.box = box;
  }

  put(key, words, x, y, gap, style) {
    const shown = words.length > 18 ? words.slice(0, 17) + "…" : words;
    const width = shown.length * 7 + 4;
    const places = [["start", x + gap, y + 4], ["end", x - gap, y + 4], ["middle", x, y - gap - 2], ["middle", x, y + gap + 11]];
    for (const [anchor, lx, ly] of places) {
      const left = anchor === "start" ? lx : anchor === "end" ? lx - width : lx - width / 2;
      const area = [left, ly - 11, left + width, ly + 3];
      const outside = area[0] < 0 || area[2] > this.box.width || area[1] < 0 || area[3] > this.box.height;
      if (outside || this.#taken.some((t) => area[0] < t[2] && area[2] > t[0] && area[1] < t[3] && area[3] > t[1])) continue;
      this.#taken.push(area);
      this.placed.push({ key, text: shown, x: lx, y: ly, anchor, class: style });
      return;
    }
  }
}
