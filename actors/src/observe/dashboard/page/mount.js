// Points for `ecod-node calibrate mount points`: each is clicked in the camera's picture and on the map, or typed.

import { byId, counted, keyed, set, text } from "./dom.js";

/// Minimum number of points from which a mount follows.
const MIN_POINTS = 4;
/// Parts of a point: [key, name, decimals].
const COLUMNS = [["column", "Column, px", 0], ["row", "Row, px", 0], ["x_m", "East, m", 2], ["y_m", "North, m", 2]];

export class MountPoints {
  #points = [];
  #number = 0;
  /// Size of the camera's frames in pixels.
  #size = null;

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

  /// Points that have a place on the map.
  get onMap() {
    return this.#isOpen ? this.#points.filter((point) => point.x_m !== undefined && point.y_m !== undefined) : [];
  }

  /// Takes the size of the camera's frames, where they tell it.
  take({ width_px, height_px }) {
    this.#size = width_px && height_px ? [width_px, height_px] : null;
  }

  draw() {
    const whole = this.#points.filter(isWhole);
    const waiting = this.#points.find(isWaiting);
    text(byId("mount-hint"), waiting ? `Now click point ${waiting.number} on the map, or type its position.`
      : whole.length < MIN_POINTS ? `Click a point of the ground in the picture, then the same point on the map. ${counted(MIN_POINTS - whole.length, "point")} to go.`
      : "Save the list as points.txt; its first line has the command. More points make the mount more certain.");
    byId("mount-table").hidden = this.#points.length === 0;
    keyed(byId("mount-rows"), this.#points, (point) => point.number, (point) => this.#row(point), (row, point) => {
      COLUMNS.forEach(([key], index) => {
        const input = row.cells[index + 1].firstChild;
        if (input !== document.activeElement) input.value = point[key] ?? "";
      });
    });
    const marks = this.#size ? this.#points.filter((point) => point.column !== undefined && point.row !== undefined) : [];
    keyed(byId("camera-picks"), this.#isOpen ? marks : [], (point) => point.number, (point) => Object.assign(document.createElement("span"), { textContent: point.number }), (mark, point) => {
      mark.style.left = `${(point.column / this.#size[0]) * 100}%`;
      mark.style.top = `${(point.row / this.#size[1]) * 100}%`;
    });
    const isReady = whole.length >= MIN_POINTS;
    byId("mount-copy").disabled = byId("mount-list").hidden = !isReady;
    const lines = whole.map(({ column, row, x_m, y_m }) => `${column},${row}=${x_m},${y_m}\n`);
    const list = `# ecod-node calibrate mount points --config node.toml --in-map points.txt\n# column,row=east,north; frames of ${this.#size?.join(" x ") ?? "?"} pixels\n${lines.join("")}`;
    if (byId("mount-list").value !== list) byId("mount-list").value = list;
    set(byId("mount-list"), { rows: lines.length + 5 });
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
    this.#points.push({ ...point, number: ++this.#number });
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
    const remove = row.insertCell().appendChild(Object.assign(document.createElement("button"), { type: "button", textContent: "×" }));
    set(remove, { "aria-label": `Remove point ${point.number}` });
    remove.onclick = () => {
      this.#points = this.#points.filter((other) => other !== point);
      this.draw();
      this.redraw();
    };
    return row;
  }

  /// Copies the list; without access to the clipboard, as from another machine, it is selected and copied the old way.
  async #copy() {
    const list = byId("mount-list");
    try {
      await navigator.clipboard.writeText(list.value);
    } catch {
      list.select();
      document.execCommand("copy");
    }
    text(byId("mount-copied"), `Copied ${counted(this.#points.filter(isWhole).length, "point")}.`);
  }
}

const isWhole = (point) => COLUMNS.every(([key]) => Number.isFinite(point[key]));
const isWaiting = (point) => point.column !== undefined && point.x_m === undefined;
