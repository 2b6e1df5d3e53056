// Details of the place, object or vehicle that is pointed at or chosen on the map.

import { ago, byId, counted, keyed, percent, text } from "./dom.js";
import { inDegrees, northOf } from "./earth.js";
import { reasons } from "./scene.js";
import { markTerm } from "./terms.js";

/// Standard deviations of the 95 % error ellipse in two dimensions: the square root of the χ² quantile.
const SIGMAS_95 = 2.4477;
/// Speed in m/s below which an object stands.
const STANDS_MPS = 0.1;
const DIRECTIONS = ["east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east"];

/// Half axes of the 95 % ellipse in metres, and the direction of the longer one.
export function ellipse([xx, xy, yy]) {
  const mean = (xx + yy) / 2;
  const half = Math.hypot((xx - yy) / 2, xy);
  return { a: SIGMAS_95 * Math.sqrt(mean + half), b: SIGMAS_95 * Math.sqrt(Math.max(mean - half, 0)), turn: Math.atan2(2 * xy, xx - yy) / 2 };
}

/// Nodes that see an object, in words.
export const sightings = ({ contributors, vehicle }) => witnesses(contributors.map((name) => (name === vehicle ? "itself" : name)));

const witnesses = (names) => (names.length === 0 ? "by no vehicle at present" : names.length === 1 ? `only by ${names[0]}` : `by ${[...names].sort().join(", ")}`);

/// Shows details in a corner of the map away from the symbol at `at` in pixels; null hides them.
export function showDetails(named, isKept, at, box) {
  const panel = byId("map-details");
  panel.hidden = !named;
  if (!named) return;
  panel.classList.toggle("kept", isKept);
  panel.classList.toggle("left", at !== null && at[0] > box.width / 2);
  text(byId("details-title"), named.title);
  keyed(byId("details-facts"), named.facts, ([what]) => what, ([what, , term]) => {
    const row = document.createElement("div");
    const head = row.appendChild(document.createElement("dt"));
    const name = head.appendChild(Object.assign(document.createElement("span"), { textContent: what }));
    if (term) markTerm(name, term);
    row.append(document.createElement("dd"));
    return row;
  }, (row, [, words]) => text(row.lastChild, words));
}

/// Title, place and facts [what, words, term] of what has this name; null without a name.
export function details(name, scene) {
  if (name === null) return null;
  const [kind, id] = [name.slice(0, name.indexOf(" ")), name.slice(name.indexOf(" ") + 1)];
  if (kind === "object") return about(scene.objects.find((object) => object.id === id), objectFacts, scene);
  if (kind === "vehicle") return about(scene.vehicles.find((vehicle) => vehicle.node === id), vehicleFacts, scene);
  return about(scene.places.find((place) => place.id === id), placeFacts, scene);
}

const about = (found, facts, scene) => (found ? facts(found, scene) : { title: "Not on the map any more", facts: [] });

function objectFacts(object, { origin }) {
  const { a, b } = ellipse(object.covariance_m2);
  const others = Object.entries(object.scores ?? {}).filter(([label]) => label !== object.label).sort((one, other) => other[1] - one[1]).slice(0, 2);
  return {
    ...standsAt(object), title: object.vehicle ? `${object.vehicle}, a vehicle` : object.label,
    facts: [
      ["Seen", sightings(object), "witnesses"],
      ["Confidence", percent(object.confidence), "confidence"],
      ["Existence", object.existence === undefined ? null : percent(object.existence), "existence"],
      ["Last seen", ago(object.age_s ?? 0)],
      ["Speed", speed(object.velocity_mps, origin)],
      ...positionFacts(object, origin),
      ["Spread", `± ${a.toFixed(2)} m × ${b.toFixed(2)} m`, "spread"],
      ["Or else", others.length > 0 ? others.map(([label, share]) => `${label} ${percent(share)}`).join(", ") : null],
    ].filter(([, words]) => words !== null),
  };
}

function vehicleFacts({ node, pose, detected, inView, votes, reputation, received_at_us }, { now, origin }) {
  return {
    ...standsAt(pose), title: node,
    facts: [
      ["Last report", ago((now - received_at_us) / 1e6)],
      ["Reputation", reputation?.toFixed(2) ?? null, "reputation"],
      ["Sees", [counted(detected ?? votes ?? 0, "object"), inView === undefined ? null : counted(inView, "place")].filter(Boolean).join(", ")],
      ...(pose ? positionFacts(pose, origin) : [["Position", "unknown"]]),
      ["Faces", pose ? direction(pose.heading_rad, origin) : null],
    ].filter(([, words]) => words !== null),
  };
}

function placeFacts(place, { origin }) {
  return {
    ...standsAt(place), title: place.id,
    facts: [
      ["Holds", place.label ?? place.words, "place"],
      ["Confidence", place.label ? percent(place.confidence) : null, "confidence"],
      ["Seen", place.contributors?.length || place.observers?.length ? witnesses([...new Set([...(place.contributors ?? []), ...(place.observers ?? [])])]) : null, "witnesses"],
      ["Why", reasons(place)],
      ...positionFacts(place, origin),
    ].filter(([, words]) => words !== null),
  };
}

const standsAt = (point) => point && { x_m: point.x_m, y_m: point.y_m };
const positionFacts = (point, origin) => [["Position", position(point, origin)], ["On Earth", origin ? inDegrees(point, origin, 7) : null]];

/// Position in the cell's frame in words. A frame whose axes are not east and north names the axes.
export function position({ x_m, y_m }, origin, decimals = 2) {
  const side = (metres, positive, negative) => `${Math.abs(metres).toFixed(decimals)} m ${metres < 0 ? negative : positive}`;
  if (northOf(origin) !== 0) return `x ${x_m.toFixed(decimals)} m, y ${y_m.toFixed(decimals)} m`;
  return `${side(x_m, "east", "west")}, ${side(y_m, "north", "south")}`;
}

/// Direction in words of an angle in the cell's frame.
function direction(angle, origin) {
  const turned = angle + (northOf(origin) * Math.PI) / 180;
  return DIRECTIONS[(Math.round(turned / (Math.PI / 4)) % 8 + 8) % 8];
}

function speed(velocity, origin) {
  if (!velocity) return null;
  const value = Math.hypot(...velocity);
  return value < STANDS_MPS ? "stands" : `${value.toFixed(1)} m/s to the ${direction(Math.atan2(velocity[1], velocity[0]), origin)}`;
}
