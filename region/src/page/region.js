// The page of a region: asks for the town in view once a second.

import { byId, counted, n, rows, span, text } from "./dom.js";
import { bounds, draw, fit, hasView, open, start } from "./town.js";

const PERIOD_MS = 1000;
const MOVED_MS = 150;
const PATIENCE_MS = 5000;

// Distinguishes this page from others of the same host: each shows one place.
const VIEWER = Math.random().toString(36).slice(2);

let latest = null;
let timer = 0;
let asking = false;

async function ask() {
  clearTimeout(timer);
  if (asking) return wait(MOVED_MS);
  asking = true;
  try {
    const seen = bounds();
    const query = seen ? `&bounds=${seen.map((degrees) => degrees.toFixed(7)).join(",")}` : "";
    const answer = await fetch(`/api/view?viewer=${VIEWER}${query}`, { signal: AbortSignal.timeout(PATIENCE_MS) });
    if (!answer.ok) throw new Error(`the region answers ${answer.status}`);
    latest = await answer.json();
    if (!hasView()) open(latest.known);
    show(latest);
  } catch (error) {
    state("stale", `No answer: ${error.message}`);
    document.body.classList.add("stale-data");
  } finally {
    asking = false;
    wait(document.hidden ? 5 * PERIOD_MS : PERIOD_MS);
  }
}

function wait(ms) {
  clearTimeout(timer);
  timer = setTimeout(ask, ms);
}

function state(kind, words) {
  byId("state").className = `state ${kind}`;
  text(byId("state-text"), words);
}

function show(town) {
  document.body.classList.toggle("stale-data", !town.broker_up);
  state(town.broker_up ? "live" : "stale", town.broker_up ? "Broker connected" : "Broker not connected");
  byId("notice").hidden = !town.trouble;
  text(byId("notice"), town.trouble ?? "");
  const { region, view } = town;
  text(byId("cells-total"), String(region.cells));
  const parts = { live: "live", told: "leading", silent: "silent", offline: "offline" };
  const told = (totals) => Object.entries(parts).filter(([key]) => totals[key]).map(([key, word]) => `${totals[key]} ${word}`).join(", ");
  text(byId("cells-more"), told(region) || "in the region");
  text(byId("view-total"), counted(view.cells, "cell"));
  text(byId("view-more"), told(view) || "move the map, or press Fit");
  text(byId("objects-total"), view.live ? String(view.objects) : "–");
  text(byId("objects-more"), view.live ? `${counted(view.vehicles, "vehicle")} among them` : town.maps_withheld ? "maps are not read" : "of maps that are read");
  const ages = town.tiles.map((tile) => tile.oldest_s).filter((age) => age !== null);
  text(byId("age-total"), ages.length ? span(Math.max(...ages)) : "–");
  text(byId("age-more"), town.maps_withheld ?? (town.has_maps ? "of the newest of each cell" : "maps are asked for"));
  byId("map-empty").hidden = region.cells > 0;
  draw(town);
  list(town);
}

function list({ cells, view }) {
  const key = (cell) => `${cell.tile} ${cell.cell}`;
  text(byId("list-count"), cells.length < view.cells ? "zoom in for single cells" : counted(view.cells, "cell"));
  byId("cells-empty").hidden = cells.length > 0;
  text(byId("cells-empty"), view.cells > 0 ? "Too many cells for a list. Zoom in, or press a tile." : "No cell is in view.");
  const word = { live: "live", told: "leads", silent: "silent", offline: "offline" };
  rows(byId("cells"), cells, key, (cell) => [
    cell.page ? { text: cell.cell, href: `http://${cell.page}/`, colour: undefined } : cell.cell,
    { text: word[cell.state], class: `cell ${cell.state}` },
    cell.leader ?? "–",
    n(cell.round === null ? "–" : cell.objects),
    n(cell.age_s === null ? "–" : span(cell.age_s)),
  ]);
  const troubles = cells.flatMap((cell) => cell.troubles.map((trouble) => ({ cell: cell.cell, tile: cell.tile, ...trouble })));
  byId("troubles-card").hidden = troubles.length === 0;
  rows(byId("troubles"), troubles, (it) => `${it.tile} ${it.cell} ${it.kind} ${it.about ?? ""}`, (it) => [
    it.cell, it.about ? `${it.about}: ${it.cause}` : it.cause, it.remedy,
  ]);
}

byId("fit").onclick = () => latest?.known && fit(latest.known);
start(() => {
  if (latest) draw(latest);
  wait(MOVED_MS);
});
ask();
