// Fit of the map: bounds that ignore a few distant objects, and signs at the border for what lies outside.

import { SURE_FROM, sureness } from "./scene.js";

const MARGIN_PX = 46;
/// Maximum pixels per metre without zoom.
const MAX_SCALE = 4000;
/// Maximum share of far points outside the fitted map, and the gain in scale for which they are left there.
const MAX_FAR = 0.25;
const FAR_GAIN = 3;
/// Distance of signs from the border in pixels, and the number of directions that share one.
const CUE_PX = 14;
const SECTORS = 12;

/// Bounds in metres: west, south, east, north. Unsure objects, vehicles that see nothing of the map, and raw detections,
/// which are less certain, count only where there is little else. Without `all`, far points are left out where the map
/// gains by it.
export function bounds({ places, objects, vehicles }, plan, box, all) {
  const looking = vehicles.filter((v) => v.objects.length + v.seen.length > 0);
  const counting = all ? objects : objects.filter((object) => sureness(object) >= SURE_FROM);
  const sure = [...places, ...counting, ...looking.map((v) => v.pose)].filter(Boolean);
  const unsure = [...objects, ...vehicles.map((v) => v.pose).filter(Boolean)];
  const more = [unsure, vehicles.flatMap((v) => v.objects)];
  const points = more.reduce((few, further) => (few.length > 1 || plan ? few : [...few, ...further]), sure);
  if (points.length === 0) return plan ?? [0, 0, 0, 0];
  const [x, y] = ["x_m", "y_m"].map((axis) => points.map((p) => p[axis]).sort((a, b) => a - b)[points.length >> 1]);
  const far = (p) => Math.hypot(p.x_m - x, p.y_m - y);
  const areas = [];
  for (const p of [...points].sort((a, b) => far(a) - far(b))) {
    areas.push(union(areas.at(-1) ?? plan ?? [p.x_m, p.y_m, p.x_m, p.y_m], [p.x_m, p.y_m, p.x_m, p.y_m]));
  }
  let area = areas.at(-1);
  for (const less of areas.slice(all ? -1 : -1 - Math.floor(points.length * MAX_FAR)).reverse()) {
    if (fitting(less, box) >= FAR_GAIN * fitting(area, box)) area = less;
  }
  return area;
}

export const union = (a, b) => [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[2], b[2]), Math.max(a[3], b[3])];

/// Pixels per metre with which the bounds fill the box.
export function fitting([left, bottom, right, top], box) {
  const margin = Math.min(MARGIN_PX, 0.13 * Math.min(box.width, box.height));
  const fill = (pixels, metres) => (pixels - 2 * margin) / Math.max(metres, 1e-3);
  return Math.min(fill(box.width, right - left), fill(box.height, top - bottom), MAX_SCALE);
}

/// Signs at the border, one for each direction in which things { name, x_m, y_m } lie outside: the nearest, how many,
/// and the sign's place and angle in degrees.
export function cues(things, at, box) {
  const [cx, cy] = [box.width / 2, box.height / 2];
  const sectors = new Map();
  for (const thing of things) {
    const [x, y] = at(thing);
    if (x >= 0 && y >= 0 && x <= box.width && y <= box.height) continue;
    const angle = Math.atan2(y - cy, x - cx);
    const sector = Math.round((angle / (2 * Math.PI)) * SECTORS + SECTORS) % SECTORS;
    const found = { ...thing, angle, off: Math.hypot(x - cx, y - cy), count: (sectors.get(sector)?.count ?? 0) + 1 };
    const nearest = found.off < (sectors.get(sector)?.off ?? Infinity) ? found : sectors.get(sector);
    sectors.set(sector, { ...nearest, count: found.count });
  }
  return [...sectors].map(([sector, { name, angle, off, count }]) => {
    const [dx, dy] = [Math.cos(angle), Math.sin(angle)];
    const reach = Math.min((cx - CUE_PX) / Math.abs(dx), (cy - CUE_PX) / Math.abs(dy));
    const words = count > 1 ? `${count} outside` : `${name}, ${distance(off / at.scale)}`;
    return { sector, count, words, x: cx + reach * dx, y: cy + reach * dy, degrees: (angle * 180) / Math.PI };
  });
}

const distance = (metres) => (metres < 10 ? `${metres.toFixed(1)} m` : metres < 10000 ? `${Math.round(metres)} m` : `${Math.round(metres / 1000)} km`);
