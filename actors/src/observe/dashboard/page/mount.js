// The mount of a camera from points of the ground: each is clicked in its picture and on the map, or typed. The node fits it.

import { byId, counted, keyed, set, text } from "./dom.js";

/// Minimum number of points from which a mount follows.
const MIN_POINTS = 4;
/// Time without changes after which the node is asked, and after which again if it had no time or no pose.
const PAUSE_MS = 300;
const RETRY_MS = 3000;
/// Parts of a point: [key, name, decimals].
const COLUMNS = [["column", "Column, px", 0], ["row", "Row, px", 0], ["x_m", "East, m", 2], ["y_m", "North, m", 2]];

export class MountPoints {
  /// Name of the camera, and points by camera.
  #camera = null;
  #lists = new Map();
  /// Size of the camera's frames in pixels.
  #size = null;
  /// The node's answer { toml, points } or { reason }, to the question `#asked`.
  #answer = null;
  #asked = "";

  constructor(map, redraw) {
    Object.assign(this, { map, redraw });
    byId("mount").onclick = () => this.#follow(byId("mount-points").hidden);
    byId("mount-add").onclick = () => {
      this.#add({});
      byId("mount-rows").lastElementChild.querySelector("input").focus();
    };
    byId("mount-copy").onclick = () => this.#copy();
    byId("camera-frame").addEventListener("click", ({ clientX, clientY }) => {
      if (!this.#isOpen || !this.#size) return;
      const { left, top, width, height } = byId("camera").getBoundingClientRect();
      const [column, row] = [((clientX - left) / width) * this.#size[0], ((clientY - top) / height) * this.#size[1]].map(Math.round);
      const waiting = this.#points.find(isWaiting);
      if (waiting) Object.assign(waiting, { column, row });
      else this.#add({ column, row });
      this.draw();
      this.redraw();
    });
  }

  get #points() {
    return this.#lists.get(this.#camera) ?? [];
  }

  set #points(points) {
    this.#lists.set(this.#camera, points);
  }

  /// Follows another camera; undefined if no camera of the node is shown alone.
  choose(camera) {
    if (camera === undefined) return this.#follow(false);
    [this.#camera, this.#size] = [camera, null];
    this.draw();
  }

  /// Points that have a place on the map.
  get onMap() {
    return this.#isOpen ? this.#points.filter((point) => point.x_m !== undefined && point.y_m !== undefined) : [];
  }

  /// Applies the size of the camera's frames, if they contain it.
  take({ width_px, height_px }) {
    const isNew = width_px !== this.#size?.[0] || height_px !== this.#size?.[1];
    this.#size = width_px && height_px ? [width_px, height_px] : null;
    if (isNew) this.draw();
  }

  draw() {
    const whole = this.#points.filter(isWhole);
    const waiting = this.#points.find(isWaiting);
    this.#ask(whole);
    text(byId("mount-hint"), waiting ? `Now click point ${waiting.number} on the map, or type its position.`
      : whole.length < MIN_POINTS ? `Click a point of the ground in the picture, then the same point on the map. ${counted(MIN_POINTS - whole.length, "point")} to go.`
      : "More points make the mount more certain, and name those that are wrong.");
    byId("mount-table").hidden = this.#points.length === 0;
    keyed(byId("mount-rows"), this.#points, (point) => point, (point) => this.#row(point), (row, point) => {
      COLUMNS.forEach(([key], index) => {
        const input = row.cells[index + 1].firstChild;
        if (input !== document.activeElement) input.value = point[key] ?? "";
      });
      const fit = this.#answer?.points?.[whole.indexOf(point)];
      const cell = row.cells[COLUMNS.length + 1];
      text(cell, !fit ? "" : [fit.error_px === null ? "not in view" : `${fit.error_px.toFixed(fit.error_px < 10 ? 1 : 0)} px`, fit.error_m === null ? "no ground" : `${fit.error_m.toFixed(2)} m`].join("\n"));
      set(cell, { class: fit?.outlier ? "n bad" : "n", title: fit?.outlier ? "contradicts the others and is left out: correct or remove it" : "" });
    });
    const marks = this.#size ? this.#points.filter((point) => point.column !== undefined && point.row !== undefined) : [];
    keyed(byId("camera-picks"), this.#isOpen ? marks : [], (point) => point.number, (point) => Object.assign(document.createElement("span"), { textContent: point.number }), (mark, point) => {
      mark.style.left = `${(point.column / this.#size[0]) * 100}%`;
      mark.style.top = `${(point.row / this.#size[1]) * 100}%`;
    });
    const { toml, reason } = this.#answer ?? {};
    const outliers = this.#answer?.points?.filter((fit) => fit.outlier).length ?? 0;
    text(byId("mount-fault"), reason ?? (outliers > 0 ? `${counted(outliers, "point")} left out: correct or remove what is red.` : ""));
    byId("mount-fault").hidden = !reason && outliers === 0;
    byId("mount-copy").disabled = byId("mount-toml").hidden = !toml;
    if (byId("mount-toml").value !== (toml ?? "")) {
      byId("mount-toml").value = toml ?? "";
      text(byId("mount-copied"), "");
    }
  }

  /// Asks the node for the mount, once for each change of the points.
  async #ask(whole) {
    const isReady = this.#isOpen && this.#size && whole.length >= MIN_POINTS;
    const points = whole.map(({ column, row, x_m, y_m }) => ({ pixel: [column, row], position_m: [x_m, y_m] }));
    const question = isReady ? JSON.stringify({ width_px: this.#size[0], height_px: this.#size[1], points }) : "";
    const path = this.#camera === null ? "/api/camera/mount" : `/api/camera/mount?name=${this.#camera}`;
    const asked = path + question;
    if (asked === this.#asked) return;
    [this.#asked, this.#answer] = [asked, null];
    if (!question) return;
    for (let pause = PAUSE_MS; pause; pause = this.#answer.passes ? RETRY_MS : 0) {
      await new Promise((over) => setTimeout(over, pause));
      const answer = asked === this.#asked && (await fitted(path, question));
      if (asked !== this.#asked) return;
      this.#answer = answer;
      this.draw();
    }
  }

  get #isOpen() {
    return !byId("mount-points").hidden;
  }

  #follow(isOpen) {
    byId("mount-points").hidden = !isOpen;
    byId("mount").setAttribute("aria-pressed", String(isOpen));
    byId("camera-frame").classList.toggle("picking", isOpen);
    this.map.follow(isOpen ? (place) => this.#place(place) : null);
    this.draw();
    this.redraw();
  }

  #place({ x_m, y_m }) {
    const waiting = this.#points.find(isWaiting);
    if (waiting) [waiting.x_m, waiting.y_m] = [x_m, y_m].map((metres) => Number(metres.toFixed(2)));
    this.draw();
    this.redraw();
  }

  #add(point) {
    this.#points = [...this.#points, { ...point, number: 1 + Math.max(0, ...this.#points.map((other) => other.number)) }];
    this.draw();
  }

  #row(point) {
    const row = document.createElement("tr");
    row.insertCell().textContent = point.number;
    for (const [key, name, decimals] of COLUMNS) {
      const input = row.insertCell().appendChild(document.createElement("input"));
      set(input, { type: "number", step: 10 ** -decimals < 1 ? "0.01" : "1", "aria-label": `${name}, of point ${point.number}` });
      input.oninput = () => {
        point[key] = input.value === "" ? undefined : Number(input.value);
        this.draw();
        this.redraw();
      };
    }
    row.insertCell();
    const remove = row.insertCell().appendChild(Object.assign(document.createElement("button"), { type: "button", textContent: "×" }));
    set(remove, { "aria-label": `Remove point ${point.number}` });
    remove.onclick = () => {
      this.#points = this.#points.filter((other) => other !== point);
      this.draw();
      this.redraw();
    };
    return row;
  }

  /// Copies the mount; without access to the clipboard, as from another machine, it is selected and copied the old way.
  async #copy() {
    const toml = byId("mount-toml");
    try {
      await navigator.clipboard.writeText(toml.value);
    } catch {
      toml.select();
      document.execCommand("copy");
    }
    text(byId("mount-copied"), "Copied.");
  }
}

/// The node's answer: a mount, or the reason why there is none, and whether that passes.
async function fitted(path, body) {
  try {
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body });
    if (answer.ok) return await answer.json();
    return { reason: (await answer.text()).trim() || `The node answers ${answer.status}.`, passes: PASSING.has(answer.status) || answer.status >= 500 };
  } catch {
    return { reason: "The node does not answer.", passes: true };
  }
}

/// Refusals that pass: too slow, no pose, too often.
const PASSING = new Set([408, 409, 429]);

const isWhole = (point) => COLUMNS.every(([key]) => Number.isFinite(point[key]));
const isWaiting = (point) => point.column !== undefined && point.x_m === undefined;
