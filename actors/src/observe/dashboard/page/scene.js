// Scene of the map, from what a node knew at one moment.

/// Colours by name, in alphabetical order.
export const colours = (names) => new Map([...new Set(names)].sort().map((name, index) => [name, index % 8]));

/// Probability of existence below which an object of the map is hidden, and below which it is pale and does not count for the fit.
export const HIDDEN_BELOW = 0.3;
export const SURE_FROM = 0.5;

/// Probability that an object exists. A map of tracks states it apart from the confidence, which includes the position's.
export const sureness = ({ existence, confidence }) => existence ?? confidence;

export const list = (names) => (names.length > 3 ? `${names.slice(0, 2).join(", ")} and ${names.length - 2} more` : names.join(", ") || "–");

/// Scene of the map: a snapshot, or the map at an earlier time, joined with known locations and colours by name.
export function arrange(picture, landmarks, now, colour) {
  const known = new Map(landmarks.map((landmark) => [landmark.id, landmark]));
  const verdicts = new Map((picture.verdicts?.message.verdicts ?? []).map((verdict) => [verdict.landmark, verdict]));
  const fused = picture.map?.message.landmarks ?? [];
  const source = fused.length > 0 ? fused : landmarks.map((l) => ({ ...l, label: verdicts.get(l.id)?.label ?? null, confidence: 0, contributors: verdicts.get(l.id)?.contributors ?? [] }));
  const places = source.map((place) => {
    const { facing_rad, vacancy } = known.get(place.id) ?? {};
    const empty = (place.observers ?? []).length > 0 || (place.label !== null && place.label === vacancy);
    const state = place.label !== null && place.label !== vacancy ? "full" : empty ? "" : "unknown";
    return { ...place, facing_rad, vacancy, state, words: empty ? "seen empty" : "not seen" };
  });
  const byNode = new Map();
  for (const sighting of picture.vehicles) {
    const { node } = sighting.report;
    byNode.set(node, [...(byNode.get(node) ?? []), sighting]);
  }
  const vehicles = [...byNode].map(([node, sightings]) => ({
    ...vehicle(node, sightings, known, colour.get(node)), reputation: picture.reputations?.message.reputations[node]?.score,
  }));
  return { places, objects: picture.map?.message.objects ?? [], vehicles, colour, now, fused_at: picture.map?.message.fused_at_us ?? picture.now_us };
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

/// Why a place has its label, in words: who read what.
export function reasons({ label, readings, vacancy, contributors }) {
  const isSign = label !== null && label === vacancy;
  if (!readings?.length) return isSign && contributors?.length ? `${list(contributors)} read the sign of the empty place` : null;
  const all = new Set(readings.flatMap(({ nodes }) => nodes)).size;
  const agreeing = readings.find((reading) => reading.label === label)?.nodes.length ?? 0;
  const others = readings.filter((reading) => reading.label !== label);
  const words = others.map((reading) => `${list(reading.nodes)} read ${reading.label === vacancy ? "the sign behind it" : reading.label}`);
  const seen = isSign ? "read the sign of the empty place" : `saw ${label ?? "nothing"}`;
  return [`${agreeing} of ${all} ${seen}`, ...words].join("; ");
}
