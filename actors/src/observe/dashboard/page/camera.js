// Pictures of cameras with their boxes, fetched only while they are in view: all on a wall, or one of them alone. A box and its object on the
// map light up together.

import { byId, keyed, set, text } from "./dom.js";
import { pageOf } from "./tables.js";

/// Maximum distance between a box's object and the one on the map, in standard deviations of both together.
const SIGMAS = 4;
/// Silence after which a picture counts as old.
const OLD_MS = 3000;
/// Number of cameras from which their pictures are small.
const MANY = 3;

export class CameraView {
  #source = null;
  #visible = false;
  /// Names under which the cameras report, and which of them is shown alone; null shows all.
  #reporters = [];
  #chosen = null;
  /// The picture of a camera that is shown alone, and those on the wall by name.
  #alone;
  #wall = new Map();
  #node = null;

  /// Calls `onLight` with the name of what is pointed at, or null, `onPicture` with the facts of each picture of a camera that is shown alone,
  /// and `onCamera` with the name of another camera of the node, or undefined if none of these is shown alone.
  constructor(onLight, onPicture, onCamera) {
    Object.assign(this, { onLight, onPicture, onCamera });
    this.#alone = new Picture(byId("camera-frame"), onLight);
    document.addEventListener("visibilitychange", () => this.#follow());
    new IntersectionObserver((looks) => {
      this.#visible = looks.at(-1).isIntersecting;
      this.#follow();
    }).observe(byId("camera-card"));
    byId("camera-name").onchange = ({ target }) => this.#choose(target.selectedIndex === 0 ? null : this.#reporters[target.selectedIndex - 1]);
    byId("mount").addEventListener("click", () => this.#chosen === null && this.#choose(this.#reporters[0]));
  }

  /// Draws boxes for what the node and others of its process see; `lit` names what is pointed at.
  draw(node, nodes, scene, lit) {
    this.#node = node;
    byId("camera-card").hidden = node.pictures.length === 0;
    this.#offer(node.pictures);
    this.#follow();
    this.#draw(scene, lit);
    const shown = node.pictures.map(vehicleOf);
    const others = nodes.filter((other) => other.alive && other.page && !shown.includes(other.name));
    keyed(byId("camera-pages"), others, (other) => other.name, () => document.createElement("a"), (link, other) => {
      set(link, { href: pageOf(other.page) });
      text(link, other.name);
    });
    byId("camera-pages").parentElement.hidden = others.length === 0;
  }

  /// Lets choose among several cameras.
  #offer(reporters) {
    const isNew = reporters.join() !== this.#reporters.join();
    // A lone camera is shown alone without a choice.
    const chosen = this.#reporters.length > 1 && reporters.includes(this.#chosen) ? this.#chosen : null;
    this.#reporters = reporters;
    const chooser = byId("camera-name");
    chooser.hidden = reporters.length < 2;
    keyed(chooser, ["All cameras", ...reporters], (name) => name, () => document.createElement("option"), (option, name) => text(option, name));
    if (isNew) this.#choose(reporters.length === 1 ? reporters[0] : chosen);
    // The list stays as it is while the user chooses.
    if (document.activeElement !== chooser) chooser.selectedIndex = reporters.indexOf(this.#chosen) + 1;
  }

  #choose(reporter) {
    this.#chosen = reporter;
    this.#close();
    this.#alone.clear();
    this.#wall.clear();
    byId("camera-frame").hidden = reporter === null;
    byId("camera-wall").hidden = reporter !== null;
    byId("camera-wall").classList.toggle("many", this.#reporters.length >= MANY);
    text(byId("camera-title"), reporter === null ? "Cameras" : "Camera");
    // The node measures the mounts of its own cameras only, which are the first.
    const own = reporter === null ? undefined : this.#node.cameras[this.#reporters.indexOf(reporter)];
    const isForeign = this.#node.cameras.length === 0 || (reporter !== null && own === undefined);
    Object.assign(byId("mount"), { disabled: isForeign, title: isForeign ? "On the page of the camera's own node" : "" });
    this.#follow();
    this.onCamera(own);
    this.onLight(null);
  }

  #draw(scene, lit) {
    const shown = this.#chosen === null ? this.#reporters : [];
    keyed(byId("camera-wall"), shown, (reporter) => reporter, (reporter) => this.#hang(reporter), (figure, reporter) => {
      const picture = this.#wall.get(reporter) ?? this.#renew(reporter, figure);
      picture.draw(scene, vehicleOf(reporter), lit);
      text(figure.querySelector(".aside"), picture.words);
    });
    if (this.#chosen === null) return text(byId("camera-more"), "");
    this.#alone.draw(scene, vehicleOf(this.#chosen), lit);
    text(byId("camera-more"), this.#alone.words);
  }

  /// A frame on the wall for the pictures of a camera; its name shows it alone.
  #hang(reporter) {
    const figure = document.createElement("figure");
    const frame = figure.appendChild(Object.assign(document.createElement("div"), { className: "picture" }));
    const canvas = frame.appendChild(document.createElement("canvas"));
    set(canvas, { width: 640, height: 360, role: "img", "aria-label": `Picture of ${reporter}` });
    frame.append(Object.assign(document.createElement("div"), { className: "boxes" }), Object.assign(document.createElement("p"), { className: "waiting", textContent: "Waiting for a picture" }));
    const caption = figure.appendChild(document.createElement("figcaption"));
    const name = caption.appendChild(Object.assign(document.createElement("button"), { type: "button", textContent: reporter, title: "Show alone" }));
    set(name, { "aria-label": `Show ${reporter} alone` });
    name.onclick = () => this.#choose(reporter);
    caption.append(Object.assign(document.createElement("span"), { className: "aside" }));
    return figure;
  }

  #renew(reporter, figure) {
    const picture = new Picture(figure.firstChild, this.onLight);
    this.#wall.set(reporter, picture);
    return picture;
  }

  #close() {
    this.#source?.close();
    this.#source = null;
  }

  #follow() {
    const wanted = this.#reporters.length > 0 && this.#visible && !document.hidden;
    if (this.#source && (!wanted || this.#source.readyState === EventSource.CLOSED)) this.#close();
    if (!wanted || this.#source) return;
    const source = (this.#source = new EventSource(this.#chosen === null ? "/api/cameras" : `/api/cameras?of=${this.#chosen}`));
    source.addEventListener("camera", (event) => this.#receive(event.lastEventId, JSON.parse(event.data), source));
  }

  async #receive(reporter, event, source) {
    const bytes = Uint8Array.from(atob(event.jpeg), (letter) => letter.charCodeAt(0));
    const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
    if (source !== this.#source) return;
    const picture = this.#chosen === null ? this.#wall.get(reporter) : this.#alone;
    picture?.show(image, event.boxes);
    image.close();
    if (this.#chosen !== null) this.onPicture(event);
    this.onLight();
  }
}

/// A camera's picture in a frame of the page.
class Picture {
  #boxes = [];
  #shownAt = -Infinity;

  constructor(frame, onLight) {
    const [canvas, boxes, waiting] = ["canvas", ".boxes", ".waiting"].map((part) => frame.querySelector(part));
    Object.assign(this, { frame, canvas, boxes, waiting, onLight });
  }

  clear() {
    [this.#boxes, this.#shownAt] = [[], -Infinity];
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  show(image, boxes) {
    [this.canvas.width, this.canvas.height] = [image.width, image.height];
    this.canvas.getContext("2d").drawImage(image, 0, 0);
    [this.#boxes, this.#shownAt] = [boxes, performance.now()];
  }

  get #isOld() {
    return performance.now() - this.#shownAt > OLD_MS;
  }

  /// What it shows, in words.
  get words() {
    return this.#isOld ? "waiting for a picture" : `${this.#boxes.length} found`;
  }

  draw(scene, vehicle, lit) {
    this.frame.classList.toggle("old", this.#isOld);
    this.waiting.hidden = this.#shownAt > 0;
    const boxes = this.#boxes.map((box, index) => ({ ...box, index, name: nameOf(box, scene, vehicle) }));
    keyed(this.boxes, boxes, (box) => box.index, () => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(document.createElement("span"));
      return button;
    }, (button, box) => {
      const [left, top, right, bottom] = box.edges.map((edge) => Math.min(Math.max(edge, 0), 1));
      const place = { left, top, width: right - left, height: bottom - top };
      for (const [side, share] of Object.entries(place)) button.style[side] = `${(share * 100).toFixed(2)}%`;
      const words = `${box.label} ${Math.round(box.confidence * 100)} %`;
      text(button.firstChild, words);
      const where = box.name ? "on the map" : box.object ? "not on the map" : "without a place";
      set(button, { class: [box.name && box.name === lit ? "lit" : "", box.object ? "" : "unplaced", top < 0.08 ? "inside" : ""].filter(Boolean).join(" "), "aria-label": `${words}, ${where}`, title: where });
      button.onpointerenter = button.onfocus = () => this.onLight(box.name);
      button.onpointerleave = button.onblur = () => this.onLight(null);
    });
  }
}

/// The vehicle of a camera that reports under this name.
const vehicleOf = (reporter) => reporter.split("--")[0];

/// Name of the place or object on the map that a box shows; null if none is there.
function nameOf({ object }, { places, objects }, node) {
  if (!object) return null;
  if (object.landmark && places.some((place) => place.id === object.landmark)) return `place ${object.landmark}`;
  const near = objects.filter((known) => known.vehicle !== node && known.contributors.includes(node)).map((known) => ({ known, sigmas: apart(known, object) }));
  const best = near.reduce((a, b) => (b.sigmas < (a?.sigmas ?? SIGMAS) ? b : a), null);
  return best && `object ${best.known.id}`;
}

/// Mahalanobis distance between two objects.
function apart(one, other) {
  const [xx, xy, yy] = one.covariance_m2.map((value, index) => value + (other.covariance_m2?.[index] ?? 0));
  const [dx, dy] = [one.x_m - other.x_m, one.y_m - other.y_m];
  return Math.sqrt((yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / (xx * yy - xy * xy));
}
