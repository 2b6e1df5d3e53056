// Trails: where moving things were in the last seconds, as far as this page has received it.

/// Length of a trail, and the time between two of its points, in microseconds.
const TRAIL_US = 8e6;
const STEP_US = 200e3;
/// Time without a map after which trails begin anew, in microseconds.
const TORN_US = 3e6;
/// Number of pieces of a trail, each paler than the one before.
const PIECES = 4;
/// Minimum length of a trail on the screen in pixels.
const MIN_PX = 12;

export class Trails {
  #points = new Map();
  #at = 0;

  /// Takes the places of things { name, x_m, y_m, spread_m } at a time in microseconds. Trails begin anew when it goes
  /// back, as by the timeline.
  take(things, at) {
    if (at < this.#at || at > this.#at + TORN_US) this.#points.clear();
    this.#at = at;
    const kept = new Map();
    for (const { name, x_m, y_m, spread_m, colour } of things) {
      const points = (this.#points.get(name)?.points ?? []).filter((point) => point.at > at - TRAIL_US);
      if (points.length === 0 || at - points.at(-1).at >= STEP_US) points.push({ x_m, y_m, at });
      kept.set(name, { points, colour, spread_m, head: { x_m, y_m, at } });
    }
    this.#points = kept;
  }

  /// Lines { key, colour, piece, d } of things that moved by more than their spread.
  lines(at) {
    return [...this.#points].flatMap(([name, { points, colour, spread_m, head }]) => {
      const moved = Math.max(...points.map((point) => Math.hypot(point.x_m - head.x_m, point.y_m - head.y_m)));
      if (moved < spread_m || moved * at.scale < MIN_PX) return [];
      const all = [...points, head];
      return Array.from({ length: PIECES }, (_, piece) => {
        const [youngest, oldest] = [piece, piece + 1].map((n) => head.at - (n * TRAIL_US) / PIECES);
        // With the next older point, so that the pieces meet.
        const inside = all.filter((point, index) => point.at <= youngest && (all[index + 1] ?? head).at > oldest);
        return { key: `${name} ${piece}`, colour, piece, d: inside.map((point, index) => `${index ? "L" : "M"}${at(point).map((c) => c.toFixed(1)).join(" ")}`).join("") };
      }).filter(({ d }) => d.includes("L"));
    });
  }
}
