// Tables and tiles of the page.

import { ago, byId, clock, milliseconds, n, percent, rows, span, text } from "./dom.js";
import { list, reasons } from "./scene.js";

const inOrder = new Intl.Collator(undefined, { numeric: true }).compare;

function fill(name, items, key, cells) {
  rows(byId(name), items, key, cells);
  const empty = byId(`${name}-empty`);
  if (empty) {
    empty.hidden = items.length > 0;
    byId(name).parentElement.hidden = items.length === 0;
  }
}

export function tiles({ leadership, map, verdicts }, now, perSecond) {
  const { leader, epoch, since_us, standby, position, failovers } = leadership;
  text(byId("leader"), leader ?? "none");
  const mine = { leading: ", this node", standing_by: "", following: "", seeking: "" }[position];
  text(byId("leader-more"), leader ? `term ${epoch}${mine}, for ${since_us ? span((now - since_us) / 1e6) : "–"}` : "no leader known");
  text(byId("standby"), standby ?? "–");
  text(byId("standby-more"), position === "standing_by" ? "this node leads next" : standby ? "leads if the leader fails" : "none named");
  const newest = map ?? verdicts;
  text(byId("round"), newest ? String(newest.message.round) : "–");
  text(byId("round-more"), newest ? `${ago((now - newest.received_at_us) / 1e6)}${perSecond === null ? "" : `, ${perSecond.toFixed(1)} a second`}` : "none yet");
  text(byId("failovers"), failovers === 1 ? "1 change of leader" : `${failovers} changes of leader`);
}

export function troubles({ troubles }) {
  byId("troubles-card").hidden = troubles.length === 0;
  rows(byId("troubles"), troubles, ({ told_by, about, kind }) => `${told_by} ${about} ${kind}`, ({ told_by, about, cause, remedy }) => [
    about ?? told_by, { text: cause, class: "warn" }, remedy, { text: told_by, class: "dim" },
  ]);
}

export function latency(samples) {
  const begin = samples.at(-1).at_us - 10e6;
  const last = samples.filter((sample) => sample.at_us > begin && sample.latency_p50_ms !== null);
  const middle = last.map((sample) => sample.latency_p50_ms).sort((a, b) => a - b)[last.length >> 1];
  const most = Math.max(...last.map((sample) => sample.latency_max_ms));
  text(byId("latency"), last.length ? milliseconds(middle) : "–");
  text(byId("latency-more"), last.length ? `median of 10 s, at most ${milliseconds(most)}` : "no map with reports in 10 s");
}

export function places(scene) {
  const entries = [
    ...scene.places.map((place) => ({ ...place, name: place.id })),
    ...scene.objects.map((object) => ({ ...object, name: `object ${object.id.slice(0, 4)}` })),
  ];
  rows(byId("places"), entries, (entry) => entry.id, (entry) => [
    entry.name, entry.label ?? { text: entry.words ?? "–", class: "dim" }, n(entry.label ? percent(entry.confidence) : "–"),
    n(entry.x_m.toFixed(2)), n(entry.y_m.toFixed(2)), n(entry.age_s === undefined ? "–" : ago(entry.age_s)), { text: reasons(entry) ?? list(entry.contributors ?? []), class: "dim" },
  ]);
}

export function verdicts(received, now) {
  const all = [...(received?.message.verdicts ?? [])].sort((a, b) => inOrder(a.landmark, b.landmark));
  fill("verdicts", all, (verdict) => verdict.landmark, (verdict) => {
    const votes = Object.entries(verdict.votes).sort((a, b) => b[1] - a[1]);
    const close = verdict.label !== null && votes.length > 1 && verdict.margin < 0.25 * verdict.score;
    return [
      verdict.landmark, verdict.label ?? { text: "undecided", class: "dim" },
      { text: votes.map(([label, score]) => `${label} ${score.toFixed(2)}`).join(", ") || "–", class: "dim" },
      { text: verdict.margin.toFixed(2) + (close ? " close" : ""), class: close ? "n warn" : "n" },
    ];
  });
  text(byId("verdicts-age"), received ? ago((now - received.received_at_us) / 1e6) : "");
}

/// Kinds of troubles for which a vehicle's reports are not used.
const REFUSALS = ["untimely", "malformed", "not_permitted"];

/// Address of a node's page, if a browser here may reach it.
export const pageOf = (page) => (page ? `http://${page}/` : undefined);

export function vehicles(entries, now, { troubles, nodes }) {
  const pages = new Map(nodes.map(({ name, page }) => [name, page]));
  const refused = new Set(troubles.filter(({ kind }) => REFUSALS.includes(kind)).map(({ about }) => about));
  fill("vehicles", entries, (vehicle) => vehicle.node, (vehicle) => {
    const age = (now - vehicle.received_at_us) / 1e6;
    const used = !refused.has(vehicle.node);
    return [
      { text: vehicle.node, colour: vehicle.colour, href: pageOf(pages.get(vehicle.node.split("--")[0])) }, n(vehicle.detected ?? "–"), n(vehicle.inView ?? "–"), n(vehicle.votes ?? "–"),
      { text: used ? ago(age) : "refused", class: age > 2 || !used ? "n bad" : "n" },
    ];
  });
  const refusals = entries.filter(({ node }) => refused.has(node)).length;
  text(byId("vehicles-count"), entries.length ? `${entries.length} reporting${refusals ? `, ${refusals} refused` : ""}` : "");
}

export function reputations(received, colour) {
  const all = Object.entries(received?.message.reputations ?? {});
  fill("reputations", all, ([name]) => name, ([name, { score, correct, incorrect }]) => [
    { text: name, colour: colour.get(name) ?? 7 }, n(score.toFixed(2)),
    n(correct), n(incorrect),
  ]);
  byId("reputation-chart").hidden = all.length === 0;
}

export function leaders({ reigns: terms }, now) {
  fill("reigns", [...terms].reverse(), (term) => `${term.leader} ${term.epoch} ${term.from_us}`, (term) => [
    term.leader, n(term.epoch), clock(term.from_us),
    term.until_us ? span((term.until_us - term.from_us) / 1e6) : { text: `${span((now - term.from_us) / 1e6)}, still leads`, class: "" },
    n(term.gap_ms === null ? "–" : milliseconds(term.gap_ms)),
  ]);
}

export function nodes({ nodes, node, leadership, now_us }) {
  const states = { following: "follows", aggregating: "leads", offline: "offline" };
  rows(byId("nodes"), nodes, (entry) => entry.name, (entry) => {
    const leads = entry.name === leadership.leader;
    const gone = entry.missing ? `gone for ${span((now_us - entry.last_seen_us) / 1e6)}, last seen ${clock(entry.last_seen_us)}` : "offline";
    const state = !entry.alive ? gone : leads ? "leads" : entry.name === leadership.standby ? "stands by" : entry.state === "aggregating" ? "follows" : states[entry.state] ?? "online";
    const unfit = entry.alive && entry.fit === false ? ", not fit to lead" : "";
    return [
      { text: entry.name + (entry.name === node.name ? " (this)" : ""), href: entry.alive ? pageOf(entry.page) : undefined }, entry.role,
      { text: state + unfit, class: entry.alive ? (unfit ? "warn" : "") : "bad" }, { text: entry.version ?? "–", class: "dim" },
    ];
  });
  const [alive, missing] = ["alive", "missing"].map((key) => nodes.filter((entry) => entry[key]).length);
  text(byId("nodes-count"), missing ? `${alive} of ${alive + missing} online` : `${alive} online`);
}

/// Reject reason of copies that arrive through a second broker; these are no loss.
const COPIES = "out_of_order";

/// Events that mean a loss or a failure, in plain words.
const DROPS = {
  publish_refused: "not sent: link down or queue full", publish_too_large: "not sent: too large", inbox_full: "dropped: node overloaded",
  name_conflict: "another node has this name", disconnected: "link lost", connect_failed: "link not established", broker_refused: "refused by a broker",
  client_throttled: "client refused: connects too often", client_timed_out: "client refused: login too late", client_untrusted: "client refused: no valid certificate",
  client_malformed: "client refused: malformed login", clients_full: "client refused: broker full", client_denied: "client request denied: no permission", client_stalled: "client disconnected: reads too slowly", client_expelled: "client disconnected: certificate revoked or expired",
  region_withheld: "map not sent to the region: link down or stalled", neighbour_refused: "neighbouring cell's object not used: elsewhere, or too many",
  overreached: "node declares more than its certificate allows",
  record_failed: "log cannot be written", record_dropped: "entry missing in the log",
  vote_ignored: "vote ignored: no usable location", report_late: "report too late for tracking", object_refused: "new object not tracked: too many", entry_left_out: "object left out of the map: out of bounds, or too many of one vehicle", reputations_not_saved: "reputations cannot be saved", frame_failed: "camera frame unusable", frame_skipped: "camera frame skipped", source_failed: "camera failed",
  detection_unplaced: "detection without a position", pose_rejected: "pose rejected", frame_without_pose: "frame without a pose", browser_refused: "browser refused", browser_throttled: "browser refused: too many requests", dashboard_not_bound: "page address already in use",
};

/// Reasons to reject a message, in plain words.
const REJECTS = {
  too_large: "too large", malformed: "cannot be read", unknown_schema: "unknown version", node_mismatch: "in another node's name", too_many_objects: "too many objects",
  not_finite: "a number that cannot be", out_of_range: "a number out of its range", confidence_out_of_range: "confidence not from 0 to 1", invalid_label: "label empty or too long",
  from_the_future: "dated in the future", stale: "too old", too_many_vehicles: "too many vehicles", too_many_cells: "too many cells", unknown_topic: "unknown topic", superseded: "of an earlier leader", not_elected: "not of the leader",
  not_fused: "for an algorithm that does not run here", bad_signature: "no valid signature", not_candidate: "evidence of a node that may not lead", unknown_term: "evidence of an unknown term",
  unattested: "evidence without proof", implausible: "more votes than there can be", not_permitted: "beyond the sender's rights",
};

const earlier = new Map();

export function drops({ counters, now_us }) {
  const rejected = Object.entries(counters.rejects).filter(([reason]) => reason !== COPIES).map(([reason, count]) => [`rejected: ${REJECTS[reason] ?? reason.replaceAll("_", " ")}`, count]);
  const shed = Object.entries(counters.shed).map(([reason, count]) => [`overload: ${reason.replaceAll("_", " ")}`, count]);
  const events = Object.entries(DROPS).map(([event, words]) => [words, counters.events[event] ?? 0]);
  const all = [...rejected, ...shed, ...events].filter(([, count]) => count > 0);
  fill("drops", all, ([reason]) => reason, ([reason, count]) => {
    const lately = recent(reason, count, now_us);
    return [reason, n(count), { text: lately ? `+${lately}` : "–", class: lately ? "n warn" : "n dim" }];
  });
}

/// Increase of a counter in the last ten seconds.
function recent(reason, count, now) {
  const kept = (earlier.get(reason) ?? [[now, count]]).filter(([, value]) => value <= count);
  if (kept.length === 0 || now - kept.at(-1)[0] > 1e6) kept.push([now, count]);
  while (kept.length > 1 && now - kept[1][0] > 10e6) kept.shift();
  earlier.set(reason, kept);
  return count - kept[0][1];
}
