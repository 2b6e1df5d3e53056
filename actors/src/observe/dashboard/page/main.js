// Draws snapshots. The map follows every snapshot; text changes four times a second, so that it can be read.

import { chart } from "./charts.js";
import { byId, span, text } from "./dom.js";
import { Live } from "./live.js";
import { BirdsEye, colours } from "./map.js";
import * as tables from "./tables.js";

const TEXT_MS = 250;
let [queued, textAt, told] = [false, 0, {}];
/// Errors by part of the page.
const faults = {};

const live = new Live(draw, () => attempt("history", drawHistory));
const map = new BirdsEye(draw);

byId("as-table").onclick = ({ target }) => {
  const asTable = byId("map-table").hidden;
  byId("map-table").hidden = !asTable;
  byId("map-frame").hidden = asTable;
  target.setAttribute("aria-pressed", String(asTable));
  textAt = 0;
  draw();
};

function draw() {
  if (queued) return;
  queued = true;
  requestAnimationFrame(() => {
    queued = false;
    if (live.picture) attempt("picture", drawPicture);
    drawState();
  });
}

/// Keeps an error, so that the page shows it instead of a healthy state.
function attempt(part, drawing) {
  try {
    drawing();
    faults[part] = null;
  } catch (error) {
    if (String(error) !== String(faults[part])) console.error(error);
    faults[part] = error;
  }
}

function drawPicture() {
  const scene = arrange(live.picture, live.landmarks, live.now);
  if (!byId("map-frame").hidden) map.draw(scene);
  if (performance.now() - textAt < TEXT_MS) return;
  drawText(live.picture, scene);
  textAt = performance.now();
}

/// Scene of the map: the snapshot joined with known locations and vehicle colours.
function arrange(picture, landmarks, now) {
  const colour = colours(picture.vehicles.map((vehicle) => vehicle.report.node).concat(Object.keys(picture.reputations?.message.reputations ?? {})));
  const known = new Map(landmarks.map((landmark) => [landmark.id, landmark]));
  const verdicts = new Map((picture.verdicts?.message.verdicts ?? []).map((verdict) => [verdict.landmark, verdict]));
  const fused = picture.map?.message.landmarks ?? [];
  const source = fused.length > 0 ? fused : landmarks.map((l) => ({ ...l, label: verdicts.get(l.id)?.label ?? null, confidence: 0, contributors: verdicts.get(l.id)?.contributors ?? [] }));
  const places = source.map((place) => {
    const empty = (place.observers ?? []).length > 0;
    const state = place.label !== null ? "full" : empty ? "" : "unknown";
    return { ...place, facing_rad: known.get(place.id)?.facing_rad, vacancy: known.get(place.id)?.vacancy, state, words: empty ? "seen empty" : "not seen" };
  });
  const byNode = new Map();
  for (const sighting of picture.vehicles) {
    const { node } = sighting.report;
    byNode.set(node, [...(byNode.get(node) ?? []), sighting]);
  }
  const vehicles = [...byNode].map(([node, sightings]) => vehicle(node, sightings, known, colour.get(node)));
  return { places, objects: picture.map?.message.objects ?? [], vehicles, colour, now };
}

/// A vehicle may report for the map, for votes, or for both.
function vehicle(node, sightings, known, colour) {
  const [detections, votes] = ["detections", "vote_detections"].map((kind) => sightings.find((sighting) => sighting.kind === kind));
  const { report } = detections ?? votes;
  return {
    node, colour, view: report.view, pose: report.pose, objects: report.objects, votes: votes?.report.objects.length,
    detected: detections?.report.objects.length, inView: report.seen?.length,
    seen: (report.seen ?? []).map((id) => known.get(id)).filter(Boolean),
    received_at_us: Math.max(...sightings.map((sighting) => sighting.received_at_us)),
  };
}

function drawText(picture, scene) {
  const { now } = scene;
  text(byId("cell"), picture.node.cell);
  text(byId("node"), picture.node.name);
  document.title = `${picture.node.cell} seen by ${picture.node.name}, ECOD`;
  const sample = live.history.samples.at(-1);
  tables.troubles(picture);
  tables.tiles(picture, now, sample ? sample.rounds / 2 : null);
  if (!byId("map-table").hidden) tables.places(scene);
  tables.verdicts(picture.verdicts, now);
  tables.vehicles(scene.vehicles, now, picture.troubles);
  tables.reputations(picture.reputations, scene.colour);
  tables.leaders(live.history, now);
  tables.nodes(picture);
  tables.drops(picture);
  text(byId("about"), `ECOD ${picture.node.version}, role ${picture.node.role}, up ${span((now - picture.node.started_at_us) / 1e6)}`);
}

/// Shows whether the page is up to date.
function drawState() {
  const { picture } = live;
  const fault = Object.values(faults).find(Boolean);
  const [look, words] = !picture ? (live.refused ? ["stale", "Sign in"] : ["waiting", "Connecting"])
    : !live.connected ? ["stale", "Connection lost"]
    : fault ? ["stale", "Cannot draw"]
    : !picture.readiness.ready ? ["unready", sentence(picture.readiness.reason)]
    : picture.troubles.length > 0 ? ["unready", `${counted(picture.troubles.length, "trouble")}, ${picture.readiness.reason}`]
    : !takesReports(picture) ? ["waiting", `No reports are used, ${picture.readiness.reason}`]
    : ["live", `Live, ${picture.readiness.reason}`];
  byId("state").className = `state ${look}`;
  text(byId("state-text"), words);
  // Apart from the words: a screen reader would repeat it every second.
  text(byId("state-age"), picture && !live.connected ? `${Math.round((live.now - picture.now_us) / 1e6)} s old` : "");
  const stale = picture !== null && (!live.connected || fault !== undefined || !picture.readiness.ready);
  document.body.classList.toggle("stale-data", stale);
  const notice = live.refused ? "This page needs the node's token: open it with ?token= and the token."
    : picture && !live.connected ? "The node does not answer. This page shows its last data."
    : fault ? `This browser cannot draw the data of the node (${fault.message}). The same data is at /api/picture.`
    : stale ? `This page may be out of date: ${picture.readiness.reason}.`
    : live.crowded ? "The node has no room for another live page: this one updates every two seconds." : "";
  text(byId("notice"), notice);
  byId("notice").hidden = notice === "";
  announce(picture);
}

/// Announces changes of the leader to screen readers; they read the state by themselves.
function announce(picture) {
  const leader = picture?.leadership.leader;
  if (leader && told.leader && leader !== told.leader) text(byId("announcer"), `${leader} leads now, in place of ${told.leader}`);
  told = { leader: leader ?? told.leader };
}

function drawHistory() {
  const { samples } = live.history;
  if (samples.length === 0) return;
  const now = samples.at(-1).at_us;
  const line = (name, colour, of, style = "line") => ({ name, colour, class: style, points: samples.map((sample) => [sample.at_us, of(sample) ?? null]) });
  tables.latency(samples);
  chart(byId("latency-chart"), {
    now, label: "Latency of maps over ten minutes, median and largest, in milliseconds", unit: "",
    lines: [line("largest", 7, (s) => s.latency_max_ms, "line soft"), line("median", 0, (s) => s.latency_p50_ms)],
  });
  chart(byId("rounds-chart"), { now, label: "Maps received a second over ten minutes", lines: [line("rounds", 2, (s) => s.rounds / 2)] });
  const names = Object.keys(samples.at(-1).reputations);
  if (names.length > 0 && live.picture) {
    const { colour } = arrange(live.picture, [], now);
    chart(byId("reputation-chart"), {
      now, label: "Reputation of each vehicle over ten minutes", ceiling: 1, names: true,
      lines: names.map((name) => line(name, colour.get(name) ?? 7, (s) => s.reputations[name])),
    });
  }
}

/// Whether the newest map or verdicts rest on reports.
function takesReports({ map, verdicts }) {
  return map?.message.oldest_capture_us !== undefined || (verdicts?.message.verdicts ?? []).some((verdict) => verdict.contributors.length > 0);
}

const counted = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;
const sentence = (words) => words.charAt(0).toUpperCase() + words.slice(1);
