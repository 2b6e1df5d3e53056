// Picture of one of the node's cameras with its boxes, fetched only while it is in view. A box and its object on the map light up together.

import { byId, keyed, set, text } from "./dom.js";

/// Maximum distance between a box's object and the one on the map, in standard deviations of both together.
const SIGMAS = 4;
/// Silence after which the picture counts as old.
const OLD_MS = 3000;

export class CameraView {
  #source = null;
  #visible = false;
  #shows = false;
  /// Names of the cameras, the first of which may have none, and which of them is shown.
  #names = [];
  #chosen = null;
  #boxes = [];
  #shownAt = -Infinity;
  #scene = null;
  #node = null;

  /// Calls `onLight` with the name of what is pointed at, or null, `onPicture` with each picture's facts, and `onCamera` with the name of another camera.
  constructor(onLight, onPicture, onCamera) {
    Object.assign(this, { onLight, onPicture, onCamera });
    document.addEventListener("visibilitychange", () => this.#follow());
    new IntersectionObserver((looks) => {
      this.#visible = looks.at(-1).isIntersecting;
      this.#follow();
    }).observe(byId("camera-card"));
    byId("camera-name").onchange = ({ target }) => this.#choose(this.#names[target.selectedIndex]);
  }

  /// Draws boxes for what the node sees; `lit` names what is pointed at.
  draw(node, scene, lit) {
    [this.#shows, this.#scene, this.#node] = [node.camera, scene, node.name];
    byId("camera-card").hidden = !node.camera;
    this.#offer(node.cameras, node.name);
    this.#follow();
    this.#draw(lit);
  }

  /// Lets choose among several cameras.
  #offer(names, vehicle) {
    this.#names = names;
    const chooser = byId("camera-name");
    chooser.hidden = names.length < 2;
    keyed(chooser, names, (name) => name, () => document.createElement("option"), (option, name) => text(option, name ?? vehicle));
    if (names.length > 0 && !names.includes(this.#chosen)) this.#choose(names[0]);
    // Not under the hand of who chooses.
    if (document.activeElement !== chooser) chooser.selectedIndex = names.indexOf(this.#chosen);
  }

  #choose(name) {
    this.#chosen = name;
    this.#source?.close();
    [this.#source, this.#boxes, this.#shownAt] = [null, [], -Infinity];
    const canvas = byId("camera");
    canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
    this.#follow();
    this.onCamera(name);
    this.onLight(null);
  }

  #draw(lit) {
    const old = performance.now() - this.#shownAt > OLD_MS;
    byId("camera-frame").classList.toggle("old", old);
    byId("camera-empty").hidden = this.#shownAt > 0;
    text(byId("camera-more"), old ? "waiting for a picture" : `${this.#boxes.length} found`);
    const boxes = this.#boxes.map((box, index) => ({ ...box, index, name: this.#scene ? nameOf(box, this.#scene, this.#node) : null }));
    keyed(byId("camera-boxes"), boxes, (box) => box.index, () => {
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

  #follow() {
    const wanted = this.#shows && this.#visible && !document.hidden;
    if (this.#source && (!wanted || this.#source.readyState === EventSource.CLOSED)) {
      this.#source.close();
      this.#source = null;
    }
    if (!wanted || this.#source) return;
    const source = (this.#source = new EventSource(this.#chosen === null ? "/api/camera" : `/api/camera?name=${this.#chosen}`));
    source.addEventListener("camera", (event) => this.#take(JSON.parse(event.data), source));
  }

  async #take({ jpeg, boxes, width_px, height_px }, source) {
    const bytes = Uint8Array.from(atob(jpeg), (letter) => letter.charCodeAt(0));
    const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
    if (source !== this.#source) return;
    const canvas = byId("camera");
    [canvas.width, canvas.height] = [image.width, image.height];
    canvas.getContext("2d").drawImage(image, 0, 0);
    image.close();
    [this.#boxes, this.#shownAt] = [boxes, performance.now()];
    this.onPicture({ width_px, height_px });
    this.onLight();
  }
}

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
