// Timeline: leaders as bands, events as marks, and a cursor that chooses the map to show.

import { byId, keyed, milliseconds, set, svg, text } from "./dom.js";

/// Half of the slider's thumb in pixels: there its middle stops.
const PAD = 9;
const STEPS = 10000;
/// Width of a mark in pixels; events that are nearer share one.
const MARK_PX = 14;
/// Maximum number of events in the list.
const MAX_LISTED = 500;
/// Signs of events, the least grave first.
const SIGNS = { joined: "▲", gap: "…", lost: "▼", took_over: "◆", trouble: "!", distrusted: "✗" };
const GRAVITY = Object.keys(SIGNS);

export class Timeline {
  /// Time in microseconds that the page shows; null for now.
  cursor = null;
  #shown = { reigns: [], events: [], frames: [], from: 0, until: 1 };

  /// Calls `onMove` when the cursor moved. `time` makes a short text of a time, `moment` a full one.
  constructor(onMove, { live, time, moment }) {
    Object.assign(this, { onMove, live, time, moment });
    const slider = byId("timeline-cursor");
    set(slider, { min: 0, max: STEPS, step: 1 });
    slider.oninput = () => {
      const { from, until } = this.#shown;
      const share = Number(slider.value) / STEPS;
      this.move(live && share === 1 ? null : from + share * (until - from));
    };
    slider.onkeydown = (event) => this.#key(event);
    new ResizeObserver(() => this.#draw()).observe(byId("timeline-bands"));
    byId("timeline-live").hidden = !live;
    byId("timeline-live").onclick = () => this.move(null);
  }

  /// Time of the map at the cursor: the latest before, or else the first; null for now.
  get frame() {
    const { frames } = this.#shown;
    return this.cursor === null ? null : frames[Math.max(this.#place(), 0)] ?? null;
  }

  move(cursor) {
    this.cursor = cursor;
    this.#draw();
    this.onMove();
  }

  /// Draws leaders, events and the times of maps between two times.
  draw({ reigns, events, frames, from, until }) {
    const took = reigns.flatMap((term, index) => {
      const before = reigns[index - 1]?.leader;
      if (!before || before === term.leader) return [];
      const gap = term.gap_ms === null ? "" : `, ${milliseconds(term.gap_ms)} after its last map`;
      return [{ at_us: term.from_us, kind: "took_over", text: `${term.leader} took over from ${before}${gap}` }];
    });
    const inside = [...events, ...took].filter(({ at_us }) => at_us >= from && at_us <= until).sort((a, b) => a.at_us - b.at_us);
    this.#shown = { reigns, frames, from, until, events: inside.map((event) => ({ ...event, key: `${event.at_us} ${event.text}` })) };
    if (this.cursor !== null) this.cursor = Math.max(this.cursor, from);
    this.#draw();
  }

  #draw() {
    const { events, from, until } = this.#shown;
    const at = this.cursor ?? until;
    const { frame } = this;
    const words = this.cursor === null ? "now" : frame === null ? "no map is held" : this.moment(frame);
    text(byId("timeline-at"), `Map: ${words}`);
    byId("map-frame").classList.toggle("past", this.live && this.cursor !== null);
    set(byId("timeline-live"), { "aria-pressed": String(this.cursor === null) });
    const slider = byId("timeline-cursor");
    slider.value = Math.round(((at - from) / (until - from)) * STEPS);
    set(slider, { "aria-valuetext": words });
    this.#picture(at);
    const listed = events.slice(-MAX_LISTED).reverse();
    keyed(byId("timeline-events"), listed, (event) => event.key, (event) => this.#entry(event), (entry, event) => {
      set(entry.firstChild, { "aria-current": event.at_us === this.cursor ? "time" : "false" });
    });
    byId("timeline-events").hidden = listed.length === 0;
    const earlier = events.length - listed.length;
    text(byId("timeline-empty"), listed.length === 0 ? "Nothing happened." : earlier > 0 ? `${earlier} earlier events are not listed.` : "");
  }

  #entry(event) {
    const entry = document.createElement("li");
    const button = entry.appendChild(document.createElement("button"));
    button.type = "button";
    for (const [name, words] of [["time", this.time(event.at_us)], [`mark ${event.kind}`, SIGNS[event.kind] ?? "•"], ["what", event.text]]) {
      const part = button.appendChild(document.createElement("span"));
      [part.className, part.textContent] = [name, words];
    }
    button.onclick = () => this.move(event.at_us);
    return entry;
  }

  /// Bands in the upper half, marks below, times at the ends.
  #picture(at) {
    const { reigns, events, from, until } = this.#shown;
    const picture = byId("timeline-bands");
    const { width } = picture.getBoundingClientRect();
    if (width < 4 * PAD) return;
    set(picture, { viewBox: `0 0 ${Math.round(width)} 62` });
    const x = (time) => PAD + (Math.min(Math.max((time - from) / (until - from), 0), 1) * (width - 2 * PAD));
    const layer = (name) => (picture[name] ??= picture.appendChild(svg("g")));
    const bands = reigns.filter((term) => (term.until_us ?? until) >= from && term.from_us <= until);
    keyed(layer("bands"), bands, (term) => `${term.leader} ${term.epoch} ${term.from_us}`, () => {
      const g = svg("g");
      g.append(svg("rect", { y: 2, height: 22, rx: 4 }), svg("text", { y: 17 }), svg("title"));
      return g;
    }, (g, term) => {
      const [left, right] = [x(term.from_us), x(term.until_us ?? until)];
      set(g, { class: `band c${this.colour?.get(term.leader) ?? 7}` });
      set(g.children[0], { x: left, width: Math.max(right - left, 2) });
      set(g.children[1], { x: left + 6 });
      text(g.children[1], term.leader.length * 7.5 + 12 < right - left ? term.leader : "");
      text(g.children[2], `${term.leader} led in term ${term.epoch} from ${this.time(term.from_us)}${term.until_us ? ` to ${this.time(term.until_us)}` : ""}`);
    });
    const marks = [];
    for (const event of events) {
      if (marks.length > 0 && x(event.at_us) - x(marks.at(-1)[0].at_us) < MARK_PX) marks.at(-1).push(event);
      else marks.push([event]);
    }
    keyed(layer("marks"), marks, ([first]) => first.key, () => {
      const g = svg("g");
      g.append(svg("rect", { y: 26, width: MARK_PX, height: 20, fill: "transparent" }), svg("text", { y: 41, "text-anchor": "middle" }), svg("title"));
      return g;
    }, (g, all) => {
      const gravest = all.reduce((a, b) => (GRAVITY.indexOf(b.kind) > GRAVITY.indexOf(a.kind) ? b : a));
      const centre = x(all[0].at_us);
      set(g, { class: `mark ${gravest.kind}` });
      set(g.children[0], { x: centre - MARK_PX / 2 });
      set(g.children[1], { x: centre });
      text(g.children[1], SIGNS[gravest.kind] ?? "•");
      text(g.children[2], all.map((event) => `${this.time(event.at_us)} ${event.text}`).join("\n"));
      g.onclick = () => this.move(gravest.at_us);
    });
    const ends = [[PAD, "start", this.time(from)], [width - PAD, "end", this.live ? "now" : this.time(until)]];
    keyed(layer("ends"), ends, (end) => end[1], () => svg("text", { y: 59 }), (element, [place, anchor, words]) => {
      set(element, { x: place, "text-anchor": anchor });
      text(element, words);
    });
    keyed(layer("cursor"), [at], () => 0, () => svg("line", { class: "cursor", y1: 0, y2: 46 }), (line) => set(line, { x1: x(at), x2: x(at) }));
  }

  /// Arrow keys move from map to map.
  #key(event) {
    const step = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    const { frames } = this.#shown;
    if (!step || frames.length === 0) return;
    event.preventDefault();
    const place = (this.cursor === null ? frames.length - 1 : this.#place()) + step;
    this.move(this.live && place >= frames.length ? null : frames[Math.min(Math.max(place, 0), frames.length - 1)]);
  }

  /// Index of the latest map at the cursor or before; -1 if all are later.
  #place() {
    const { frames } = this.#shown;
    const after = frames.findIndex((time) => time > this.cursor);
    return (after < 0 ? frames.length : after) - 1;
  }
}
