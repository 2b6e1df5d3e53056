// Details of the place, object or vehicle that is pointed at or chosen on the map.

import { ago, byId, counted, keyed, percent, text } from "./dom.js";
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
export function details(name, { places, objects, vehicles, now }) {
  if (name === null) return null;
  const [kind, id] = [name.slice(0, name.indexOf(" ")), name.slice(name.indexOf(" ") + 1)];
  if (kind === "object") return about(objects.find((object) => object.id === id), objectFacts);
  if (kind === "vehicle") return about(vehicles.find((vehicle) => vehicle.node === id), (vehicle) => vehicleFacts(vehicle, now));
  return about(places.find((place) => place.id === id), placeFacts);
}

const about = (found, facts) => (found ? facts(found) : { title: "Not on the map any more", facts: [] });

function objectFacts(object) {
  const { a, b } = ellipse(object.covariance_m2);
  const others = Object.entries(object.scores ?? {}).filter(([label]) => label !== object.label).sort((one, other) => other[1] - one[1]).slice(0, 2);
  return {
    ...standsAt(object), title: object.vehicle ? `${object.vehicle}, a vehicle` : object.label,
    facts: [
      ["Seen", sightings(object), "witnesses"],
      ["Confidence", percent(object.confidence), "confidence"],
      ["Existence", object.existence === undefined ? null : percent(object.existence), "existence"],
      ["Last seen", ago(object.age_s ?? 0)],
      ["Speed", speed(object.velocity_mps)],
      ["Position", position(object)],
      ["Spread", `± ${a.toFixed(2)} m × ${b.toFixed(2)} m`, "spread"],
      ["Or else", others.length > 0 ? others.map(([label, share]) => `${label} ${percent(share)}`).join(", ") : null],
    ].filter(([, words]) => words !== null),
  };
}

function vehicleFacts({ node, pose, detected, inView, votes, reputation, received_at_us }, now) {
  return {
    ...standsAt(pose), title: node,
    facts: [
      ["Last report", ago((now - received_at_us) / 1e6)],
      ["Reputation", reputation?.toFixed(2) ?? null, "reputation"],
      ["Sees", [counted(detected ?? votes ?? 0, "object"), inView === undefined ? null : counted(inView, "place")].filter(Boolean).join(", ")],
      ["Position", pose ? position(pose) : "unknown"],
      ["Faces", pose ? direction(pose.heading_rad) : null],
    ].filter(([, words]) => words !== null),
  };
}

function placeFacts(place) {
  return {
    ...standsAt(place), title: place.id,
    facts: [
      ["Holds", place.label ?? place.words, "place"],
      ["Confidence", place.label ? percent(place.confidence) : null, "confidence"],
      ["Seen", place.contributors?.length || place.observers?.length ? witnesses([...new Set([...(place.contributors ?? []), ...(place.observers ?? [])])]) : null, "witnesses"],
      ["Why", reasons(place)],
      ["Position", position(place)],
    ].filter(([, words]) => words !== null),
  };
}

const standsAt = (point) => point && { x_m: point.x_m, y_m: point.y_m };
const position = ({ x_m, y_m }) => `${side(x_m, "east", "west")}, ${side(y_m, "north", "south")}`;
const side = (metres, positive, negative) => `${Math.abs(metres).toFixed(2)} m ${metres < 0 ? negative : positive}`;
const direction = (angle) => DIRECTIONS[(Math.round(angle / (Math.PI / 4)) % 8 + 8) % 8];

function speed(velocity) {
  if (!velocity) return null;
  const value = Math.hypot(...velocity);
  return value < STANDS_MPS ? "stands" : `${value.toFixed(1)} m/s to the ${direction(Math.atan2(velocity[1], velocity[0]))}`;
}
