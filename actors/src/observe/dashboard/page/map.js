// Bird's-eye view: world metres to screen pixels, symbols of constant size. Unsure objects are pale or hidden.

import { details, ellipse, position, showDetails, sightings } from "./details.js";
import { byId, counted, keyed, percent, set, span, svg, text } from "./dom.js";
import { inDegrees, northOf } from "./earth.js";
import { bounds, cues, fitting, union } from "./fit.js";
import { FloorPlan } from "./floor.js";
import { Labels } from "./labels.js";
import { HIDDEN_BELOW, SURE_FROM, sureness } from "./scene.js";
import { Trails } from "./trails.js";

/// Maximum number of drawn places, and of objects; the table has all.
const MAX_DRAWN = 2000;
/// Age in seconds from which silent vehicles and unseen objects are drawn pale with their age.
const OLD_S = 2;
/// Width and height in pixels below which nothing is drawn.
const MIN_BOX_PX = 100;
/// Time for which a part of the map must have been enough before it is fitted again, and the gain in scale for which it is.
const ROOMY_MS = 5000;
const ROOMY_GAIN = 1.5;
/// Movement of a pressed pointer in pixels from which it drags the map.
const DRAG_PX = 4;
/// Half axis of an ellipse in pixels from which it is not filled.
const VAST_PX = 150;
/// Radius in pixels around an object in which it is pointed at.
const REACH_PX = 11;
/// Place of the north arrow above the lower left corner, and its length, in pixels.
const NORTH_PX = [26, 56];
const NORTH_LENGTH_PX = 15;
/// Ranks of labels: a label of a higher rank takes its place before others. Objects have 1 and their sureness.
const RANKS = { lit: 6, pick: 5, vehicle: 4, cue: 3, place: 2, object: 1, free: 0 };

export class BirdsEye {
  #picture = byId("map");
  #layers = {};
  #bounds = null;
  #fullAt = 0;
  #zoom = 1;
  #shift = [0, 0];
  /// True if far things count for the fit, too.
  #all = false;
  #kept = null;
  #trails = new Trails();
  #at = null;
  /// True if the present press dragged the map.
  #dragged = false;
  #onPick = null;
  #known = [];
  #labels = new Labels();
  /// Whether objects are shown that are too unsure.
  #showsUnsure = false;
  /// The mouse on the map in pixels, or null, and the origin of the frame.
  #pointer = null;
  #origin = null;
  /// Whether a table is shown in the place of the map.
  asTable = false;
  /// Name of the symbol that is pointed at, here or elsewhere: its kind and identity.
  lit = null;

  /// Calls `onLight` with the name of the symbol that is pointed at, or null.
  constructor(redraw, onLight = (name) => {
    this.lit = name;
    redraw();
  }) {
    Object.assign(this, { redraw, onLight });
    for (const name of ["floor", "grid", "views", "trails", "places", "dots", "objects", "vehicles", "picks", "labels", "cues", "scale"]) {
      this.#layers[name] = this.#picture.appendChild(svg("g"));
    }
    this.floor = new FloorPlan(this.#layers.floor, redraw);
    byId("map-outside").onclick = () => this.#fit(true);
    byId("details-close").onclick = () => this.#keep(null);
    byId("zoom-in").onclick = () => this.#zoomBy(1.4);
    byId("zoom-out").onclick = () => this.#zoomBy(1 / 1.4);
    byId("fit").onclick = () => this.#fit();
    byId("map-unsure").onclick = () => {
      this.#showsUnsure = !this.#showsUnsure;
      redraw();
    };
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
    this.#readOff();
    new ResizeObserver(redraw).observe(this.#picture);
  }

  /// Gives the position in metres of each click on the map to `onPick`, until it is null.
  follow(onPick) {
    this.#onPick = onPick;
    this.#picture.classList.toggle("picking", onPick !== null);
  }

  /// Draws { places, objects, vehicles, now, fused_at, origin }, and `picks`, numbered points in metres. The north arrow
  /// needs an origin, or null for a frame that has none; it is left out where that is unknown.
  draw(all, picks = []) {
    const box = this.#picture.getBoundingClientRect();
    const empty = all.places.length + all.objects.length + all.vehicles.length === 0;
    const scene = { ...all, objects: this.#sureEnough(all.objects) };
    byId("map-empty").hidden = !empty || this.floor.bounds !== null;
    if (Math.min(box.width, box.height) <= MIN_BOX_PX || (empty && !this.floor.bounds)) return;
    set(this.#picture, { viewBox: `0 0 ${Math.round(box.width)} ${Math.round(box.height)}`, "aria-label": describe(scene, all.objects.length - scene.objects.length) });
    this.#picture.classList.toggle("zoomed", this.#zoom !== 1);
    const at = this.#projection({ ...scene, places: [...scene.places, ...picks] }, box);
    [this.#at, this.#known, this.#origin] = [at, scene.places, scene.origin];
    const labels = this.#labels;
    labels.begin(box, this.#picture);
    this.floor.draw(at);
    this.#grid(at, box, scene.origin, labels);
    this.#move(scene, at);
    this.#picks(picks, at, labels);
    this.#places(scene.places.slice(0, MAX_DRAWN), at, labels);
    const posed = new Set(scene.vehicles.filter((v) => v.pose).map((v) => v.node));
    this.#objects(scene.objects.slice(0, MAX_DRAWN), posed, at, labels);
    this.#vehicles(scene.vehicles, scene.now, at, labels);
    this.#cues(scene, at, box, labels);
    this.#details(all, at, box);
    this.#showPointer();
    labels.place();
    keyed(this.#layers.labels, labels.placed, (label) => label.key, () => svg("text"), (element, label) => {
      set(element, { x: label.x, y: label.y, "text-anchor": label.anchor, class: label.class });
      text(element, label.text);
    });
  }

  #projection(scene, box) {
    this.#growBounds(scene, box);
    const [left, bottom, right, top] = this.#bounds;
    const scale = fitting(this.#bounds, box) * this.#zoom;
    const [cx, cy] = [box.width / 2 + this.#shift[0], box.height / 2 + this.#shift[1]];
    const at = (p) => [cx + (p.x_m - (left + right) / 2) * scale, cy - (p.y_m - (bottom + top) / 2) * scale];
    const back = (x, y) => ({ x_m: (x - cx) / scale + (left + right) / 2, y_m: (cy - y) / scale + (bottom + top) / 2 });
    return Object.assign(at, { scale, back });
  }

  /// Bounds grow at once and shrink late, so that the map stays steady while vehicles come and go, and recovers from a
  /// wrong position. Moved or zoomed by hand, the map keeps its bounds until Fit.
  #growBounds(scene, box) {
    const moved = this.#zoom !== 1 || this.#shift.some((shift) => shift !== 0);
    if (this.#bounds && moved) return;
    const now = performance.now();
    const needed = bounds(scene, this.floor.bounds, box, this.#all);
    const grown = union(this.#bounds ?? needed, needed);
    if (fitting(needed, box) < ROOMY_GAIN * fitting(grown, box)) this.#fullAt = now;
    this.#bounds = now - this.#fullAt > ROOMY_MS ? needed : grown;
  }

  /// Objects that are sure enough to be shown, and those that are pointed at or chosen, here or in a picture.
  #sureEnough(objects) {
    const isUnsure = (object) => sureness(object) < HIDDEN_BELOW;
    const unsure = objects.filter(isUnsure).length;
    const button = byId("map-unsure");
    button.hidden = unsure === 0;
    button.setAttribute("aria-pressed", String(this.#showsUnsure));
    text(button, `${counted(unsure, "unsure object")} ${this.#showsUnsure ? "shown, hide" : "hidden, show"}`);
    if (this.#showsUnsure) return objects;
    return objects.filter((object) => !isUnsure(object) || [this.lit, this.#kept].includes(`object ${object.id}`));
  }

  #grid(at, box, origin, labels) {
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
      const north = g.appendChild(svg("g", { class: "north" }));
      north.append(svg("path", { d: "M0 -11L5 7L0 3L-5 7Z" }), svg("text", { "text-anchor": "middle" }));
      text(north.lastChild, "N");
      return g;
    }, (g) => {
      const y = box.height - 12;
      const [rule, length, north] = g.children;
      set(rule, { d: `M12 ${y - 5}v5h${px.toFixed(1)}v-5` });
      set(length, { x: 18 + px, y });
      text(length, step >= 1000 ? `${step / 1000} km` : step >= 1 ? `${step} m` : `${+(step * 100).toFixed(1)} cm`);
      labels.reserve([8, y - 14, 70 + px, box.height]);
      this.#north(north, origin, box, labels);
    });
  }

  /// Points to north; "N" stands at the tip, upright.
  #north(arrow, origin, box, labels) {
    set(arrow, { visibility: origin === undefined ? "hidden" : "visible" });
    if (origin === undefined) return;
    const [x, y] = [NORTH_PX[0], box.height - NORTH_PX[1]];
    const angle = (northOf(origin) * Math.PI) / 180;
    const reach = NORTH_LENGTH_PX + 4;
    set(arrow.firstChild, { transform: `translate(${x} ${y}) rotate(${northOf(origin).toFixed(1)})` });
    set(arrow.lastChild, { x: x + reach * Math.sin(angle), y: y - reach * Math.cos(angle) + 4 });
    labels.reserve([x - 24, y - 28, x + 24, y + 24]);
  }

  /// Shows the position at the mouse, or where a finger touched.
  #readOff() {
    const take = (event) => {
      const { left, top } = this.#picture.getBoundingClientRect();
      this.#pointer = event && [event.clientX - left, event.clientY - top];
      this.#showPointer();
    };
    for (const kind of ["pointermove", "pointerdown"]) this.#picture.addEventListener(kind, take);
    this.#picture.addEventListener("pointerleave", ({ pointerType }) => pointerType !== "touch" && take(null));
  }

  #showPointer() {
    if (!this.#pointer || !this.#at) return text(byId("map-at"), "Point at the map for coordinates");
    const { scale, back } = this.#at;
    const place = back(...this.#pointer);
    const decimals = scale >= 100 ? 2 : scale >= 5 ? 1 : 0;
    const words = position(place, this.#origin, decimals);
    text(byId("map-at"), this.#origin ? `${words}; ${inDegrees(place, this.#origin, decimals + 5)}` : words);
  }

  #places(places, at, labels) {
    keyed(this.#layers.places, places, (place) => place.id, () => {
      const g = svg("g");
      g.append(svg("line", { class: "facing" }), svg("rect", { width: 11, height: 11, rx: 3 }));
      // The table has all places for the keyboard.
      return set(g, { tabindex: -1, role: "button" });
    }, (g, place) => {
      const [x, y] = at(place);
      const [line, sign] = g.children;
      set(g, { class: this.#light(g, `place ${place.id}`), "aria-label": `${place.id}: ${place.label ?? place.words}` });
      const facing = place.facing_rad ?? null;
      const reach = facing === null ? 0 : 13;
      set(line, { x1: x, y1: y, x2: x + reach * Math.cos(facing ?? 0), y2: y - reach * Math.sin(facing ?? 0) });
      set(sign, { x: x - 5.5, y: y - 5.5, class: `place ${place.state}` });
      const [rank, style] = place.label ? [RANKS.place, ""] : [RANKS.free, "dim"];
      labels.put({ key: `place ${place.id}`, rank, words: place.label ?? place.id, x, y, gap: 9, style });
    });
  }

  #objects(objects, vehicles, at, labels) {
    keyed(this.#layers.objects, objects, (object) => object.id, () => {
      const g = svg("g");
      g.append(svg("line", { class: "motion" }), svg("ellipse"), svg("circle", { class: "reach", r: REACH_PX }), svg("circle", { class: "centre", r: 2.5 }));
      return reachable(g);
    }, (g, object) => {
      const [x, y] = at(object);
      const { a, b, turn } = ellipse(object.covariance_m2);
      const [motion, around, reach, centre] = g.children;
      const [east, north] = object.velocity_mps ?? [0, 0];
      const [x2, y2] = at({ x_m: object.x_m + east, y_m: object.y_m + north });
      set(motion, { x1: x, y1: y, x2, y2 });
      const degrees = ((-turn * 180) / Math.PI).toFixed(1);
      // An ellipse over much of the map would hide the rest.
      set(around, { class: a * at.scale > VAST_PX ? "ellipse vast" : "ellipse", rx: Math.max(a * at.scale, 5), ry: Math.max(b * at.scale, 5), transform: `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${degrees})` });
      for (const circle of [reach, centre]) set(circle, { cx: x, cy: y });
      const age = object.age_s ?? 0;
      const name = `object ${object.id}`;
      const isUnsure = sureness(object) < SURE_FROM;
      const paleness = `${age > OLD_S ? "old" : ""} ${isUnsure ? "unsure" : ""}`.trim();
      const lit = this.#light(g, name);
      // The vehicle's own symbol is reached instead.
      const what = object.vehicle ?? object.label;
      set(g, { class: `${paleness} ${lit}`.trim(), tabindex: object.vehicle ? -1 : 0, "aria-label": `${what}, ${percent(object.confidence)}, ${isUnsure ? "unsure, " : ""}seen ${sightings(object)}` });
      // The vehicle's own symbol has the name.
      if (!vehicles.has(object.vehicle)) labels.put({ key: name, rank: lit ? RANKS.lit : RANKS.object + sureness(object), words: aged(what, age), x, y, gap: 9, style: paleness });
    });
  }

  /// Class of a symbol, which reports when it is pointed at.
  #light(symbol, name) {
    symbol.onpointerenter = symbol.onfocus = () => this.onLight(name);
    symbol.onpointerleave = symbol.onblur = () => this.onLight(null);
    symbol.onclick = (event) => {
      if (this.#onPick || this.#dragged) return;
      event.stopPropagation();
      this.#keep(this.#kept === name ? null : name);
    };
    symbol.onkeydown = (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      this.#keep(this.#kept === name ? null : name);
    };
    return this.lit === name || this.#kept === name ? "lit" : "";
  }

  /// Keeps the details of what has this name, until others are chosen.
  #keep(name) {
    this.#kept = name;
    this.redraw();
  }

  #details(scene, at, box) {
    const name = this.lit ?? this.#kept;
    const named = details(name, scene);
    showDetails(named, name !== null && name === this.#kept, named?.x_m === undefined ? null : at(named), box);
  }

  #move({ objects, vehicles, fused_at }, at) {
    const moving = objects.filter((object) => !object.vehicle).map((object) => ({ ...object, name: `object ${object.id}`, spread_m: ellipse(object.covariance_m2).a }));
    const driving = vehicles.filter((v) => v.pose).map((v) => ({ ...v.pose, name: `vehicle ${v.node}`, spread_m: 0, colour: v.colour }));
    this.#trails.take([...moving.slice(0, MAX_DRAWN), ...driving], fused_at);
    keyed(this.#layers.trails, this.#trails.lines(at), (line) => line.key, () => svg("path"), (path, { colour, piece, d }) => {
      set(path, { class: `trail p${piece} ${colour === undefined ? "" : `c${colour}`}`.trim(), d });
    });
  }

  /// Position in metres at a place on the screen: of a known place that is drawn there, or else of the ground.
  #positionAt(x, y) {
    const off = (place) => Math.hypot(...this.#at(place).map((side, axis) => side - [x, y][axis]));
    return this.#known.find((place) => off(place) < REACH_PX) ?? this.#at.back(x, y);
  }

  #picks(picks, at, labels) {
    keyed(this.#layers.picks, picks, (pick) => pick.number, () => svg("path", { class: "pick", d: "M-7 0H7M0 -7V7" }), (path, pick) => {
      const [x, y] = at(pick);
      set(path, { transform: `translate(${x.toFixed(1)} ${y.toFixed(1)})` });
      labels.put({ key: `pick ${pick.number}`, rank: RANKS.pick, words: String(pick.number), x, y, gap: 9, style: "pick" });
    });
  }

  /// Signs at the border for what is outside, and a button that shows all of it.
  #cues({ places, objects, vehicles }, at, box, labels) {
    const things = [
      ...objects.map((object) => ({ ...object, name: object.vehicle ?? object.label })),
      ...vehicles.filter((v) => v.pose).map((v) => ({ ...v.pose, name: v.node })), ...places.map((place) => ({ ...place, name: place.id })),
    ];
    const outside = cues(things, at, box);
    keyed(this.#layers.cues, outside, (cue) => cue.sector, () => svg("path", { class: "cue", d: "M8 0L-6 7L-2 0L-6 -7Z" }), (path, cue) => {
      set(path, { transform: `translate(${cue.x.toFixed(1)} ${cue.y.toFixed(1)}) rotate(${cue.degrees.toFixed(1)})` });
      labels.put({ key: `cue ${cue.sector}`, rank: RANKS.cue, words: cue.words, x: cue.x, y: cue.y, gap: 12, style: "cue" });
    });
    const count = outside.reduce((sum, cue) => sum + cue.count, 0);
    byId("map-outside").hidden = count === 0;
    text(byId("map-outside"), `${count} outside, show all`);
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
      g.append(svg("path", { class: "body", d: "M12 0L-8 7.5L-4 0L-8 -7.5Z" }));
      return reachable(g);
    }, (g, v) => {
      const [x, y] = at(v.pose);
      const degrees = ((-v.pose.heading_rad * 180) / Math.PI).toFixed(1);
      set(g, { class: `c${v.colour} ${old(v)} ${this.#light(g, `vehicle ${v.node}`)}`.trim() });
      set(g.firstChild, { transform: `translate(${x.toFixed(1)} ${y.toFixed(1)}) rotate(${degrees})` });
      const age = (now - v.received_at_us) / 1e6;
      set(g, { "aria-label": `${v.node}, a vehicle` });
      labels.put({ key: `vehicle ${v.node}`, rank: RANKS.vehicle, words: aged(v.node, age), x, y, gap: 14, style: `vehicle c${v.colour} ${old(v)}` });
    });
  }

  #zoomBy(factor) {
    const zoom = Math.min(Math.max(this.#zoom * factor, 0.2), 60);
    this.#shift = this.#shift.map((shift) => (shift * zoom) / this.#zoom);
    this.#zoom = zoom;
    this.redraw();
  }

  #fit(all = false) {
    [this.#zoom, this.#shift, this.#bounds, this.#all] = [1, [0, 0], null, all];
    this.redraw();
  }

  #key(event) {
    const move = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] }[event.key];
    if (move) this.#shift = [this.#shift[0] + move[0], this.#shift[1] + move[1]];
    else if (event.key === "+" || event.key === "=") return this.#zoomBy(1.4);
    else if (event.key === "-") return this.#zoomBy(1 / 1.4);
    else if (event.key === "0") return this.#fit();
    else if (event.key === "Escape") return this.#keep(null);
    else return;
    event.preventDefault();
    this.redraw();
  }

  /// Touch scrolls the page until the map is zoomed, then moves the map. A press that does not move is a click.
  #drag() {
    let last = null;
    this.#picture.addEventListener("pointerdown", (event) => {
      this.#dragged = false;
      if (!event.isPrimary || (event.pointerType === "touch" && this.#zoom === 1)) return;
      last = [event.clientX, event.clientY];
    });
    this.#picture.addEventListener("pointermove", (event) => {
      if (!last || !event.isPrimary) return;
      const [x, y] = [event.clientX - last[0], event.clientY - last[1]];
      if (!this.#dragged && Math.hypot(x, y) < DRAG_PX) return;
      if (!this.#dragged) this.#picture.setPointerCapture(event.pointerId);
      this.#dragged = true;
      this.#picture.classList.add("dragging");
      this.#shift = [this.#shift[0] + x, this.#shift[1] + y];
      last = [event.clientX, event.clientY];
      this.redraw();
    });
    for (const end of ["pointerup", "pointercancel"]) {
      this.#picture.addEventListener(end, () => {
        last = null;
        this.#picture.classList.remove("dragging");
      });
    }
    this.#picture.addEventListener("click", (event) => {
      if (this.#dragged) return;
      const { left, top } = this.#picture.getBoundingClientRect();
      if (this.#onPick && this.#at) this.#onPick(this.#positionAt(event.clientX - left, event.clientY - top));
      else this.#keep(null);
    });
  }
}

/// A symbol that the keyboard reaches.
const reachable = (symbol) => set(symbol, { tabindex: 0, role: "button", "aria-describedby": "details-facts" });

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
function describe({ places, objects, vehicles }, hidden) {
  const labelled = places.filter((place) => place.label).length;
  const unsure = hidden > 0 ? `, without ${counted(hidden, "unsure object")}` : "";
  return `Map of ${places.length} places, ${labelled} with a label, ${objects.length} other objects and ${vehicles.length} vehicles${unsure}`;
}
