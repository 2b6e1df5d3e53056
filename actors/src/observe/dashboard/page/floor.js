// Floor plan under the map: an image of the node, placed by two known points.

import { set, svg } from "./dom.js";

export class FloorPlan {
  #image = svg("image", { class: "floor" });
  #metres = null;
  #size = null;

  constructor(layer, redraw) {
    layer.append(this.#image);
    this.redraw = redraw;
  }

  /// Takes { path, metres }; `metres` takes pixels to metres, in the order of SVG matrices. Undefined where there is none.
  async take(plan) {
    if (!plan || this.#metres) return;
    this.#metres = plan.metres;
    const image = new Image();
    image.src = plan.path;
    await image.decode();
    this.#size = [image.naturalWidth, image.naturalHeight];
    set(this.#image, { href: plan.path, width: this.#size[0], height: this.#size[1] });
    this.redraw();
  }

  /// West, south, east and north in metres; null without a plan.
  get bounds() {
    if (!this.#size) return null;
    const [width, height] = this.#size;
    const [a, b, c, d, e, f] = this.#metres;
    const corners = [[0, 0], [width, 0], [0, height], [width, height]].map(([x, y]) => [a * x + c * y + e, b * x + d * y + f]);
    const [xs, ys] = [0, 1].map((axis) => corners.map((corner) => corner[axis]));
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }

  /// Draws the plan where `at` takes metres to pixels of the screen.
  draw(at) {
    if (!this.#size) return;
    const [x, y] = at({ x_m: 0, y_m: 0 });
    const [a, b, c, d, e, f] = this.#metres.map((value) => value * at.scale);
    set(this.#image, { transform: `matrix(${[a, -b, c, -d, x + e, y - f].join(" ")})` });
  }
}
