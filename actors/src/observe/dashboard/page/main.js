// Draws snapshots. The map follows every snapshot; text changes four times a second, so that it can be read.

import { CameraView } from "./camera.js";
import { chart } from "./charts.js";
import { ago, byId, clock, counted, span, text } from "./dom.js";
import { Live, SPAN_US } from "./live.js";
import { BirdsEye } from "./map.js";
import { MountPoints } from "./mount.js";
import { arrange, colours } from "./scene.js";
import { explainTerms } from "./terms.js";
import * as tables from "./tables.js";
import { Timeline } from "./timeline.js";

const TEXT_MS = 250;
let [queued, textAt, told] = [false, 0, {}];
/// Errors by part of the page.
const faults = {};

explainTerms();
// The heading of a table covers the shadow above its rows.
document.addEventListener("scroll", ({ target }) => target.classList?.toggle("scrolled", target.scrollTop > 0), true);
const live = new Live(draw, () => attempt("history", drawHistory));
const map = new BirdsEye(draw, light);
const mount = new MountPoints(map, draw);
const camera = new CameraView(light, (picture) => mount.take(picture), (name) => mount.choose(name));
const timeline = new Timeline(scrub, { live: true, time: clock, moment: (at) => `${clock(at)}, ${ago((live.now - at) / 1e6)}` });
/// The map that the timeline chose, and whether one is on its way.
let [past, loading] = [null, false];

async function scrub() {
  draw();
  if (loading) return;
  loading = true;
  while (timeline.frame !== (past?.at ?? null)) {
    const at = timeline.frame;
    past = at && { at, picture: (await live.frame(at)) ?? past?.picture };
  }
  loading = false;
  draw();
}

/// Lights up what has this name, on the map and in the picture; without a name only draws anew.
function light(name) {
  if (name !== undefined) map.lit = name;
  draw();
}

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
  const { picture, landmarks, now } = live;
  const known = (of) => (of ? of.vehicles.map((vehicle) => vehicle.report.node) : []);
  const rated = Object.keys(picture.reputations?.message.reputations ?? {});
  const colour = colours([...known(picture), ...known(past?.picture), ...rated, ...live.history.reigns.map((term) => term.leader)]);
  const scene = arrange(picture, landmarks, now, colour);
  const shown = past?.picture ? arrange(past.picture, landmarks, past.picture.now_us, colour) : scene;
  map.floor.take(picture.node.floor_plan).catch((error) => (faults["floor plan"] = error));
  if (!map.asTable) map.draw({ ...shown, origin: picture.node.origin ?? null }, mount.onMap);
  camera.draw(picture.node, picture.nodes, scene, map.lit);
  if (performance.now() - textAt < TEXT_MS) return;
  if (map.asTable) tables.places(shown);
  drawText(picture, scene);
  drawTimeline(scene);
  textAt = performance.now();
}

function drawTimeline({ colour, now }) {
  const { reigns, events, frames } = live.history;
  const first = Math.min(now - 60e6, reigns[0]?.from_us ?? now, events[0]?.at_us ?? now, frames[0] ?? now);
  timeline.colour = colour;
  timeline.draw({ reigns, events, frames, from: Math.max(first, now - SPAN_US), until: now });
  // The chosen map may be too old to be held any more.
  if (timeline.frame !== (past?.at ?? null)) scrub();
}

function drawText(picture, scene) {
  const { now } = scene;
  text(byId("cell"), picture.node.cell);
  text(byId("node"), picture.node.name);
  document.title = `${picture.node.cell} seen by ${picture.node.name}, ECOD`;
  const sample = live.history.samples.at(-1);
  tables.troubles(picture);
  tables.tiles(picture, now, sample ? sample.rounds / 2 : null);
  tables.verdicts(picture.verdicts, now);
  text(byId("vehicles-empty"), sentence(picture.node.guide));
  text(byId("map-empty"), picture.map ? "The map is empty: no vehicle has reported an object or its place" : "Waiting for the first map");
  tables.vehicles(scene.vehicles, now, picture);
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
    chart(byId("reputation-chart"), {
      now, label: "Reputation of each vehicle over ten minutes", ceiling: 1, names: true,
      lines: names.map((name) => line(name, timeline.colour?.get(name) ?? 7, (s) => s.reputations[name])),
    });
  }
}

/// Whether the newest map or verdicts rest on reports.
function takesReports({ map, verdicts }) {
  return map?.message.oldest_capture_us !== undefined || (verdicts?.message.verdicts ?? []).some((verdict) => verdict.contributors.length > 0);
}

const sentence = (words) => words.charAt(0).toUpperCase() + words.slice(1);
