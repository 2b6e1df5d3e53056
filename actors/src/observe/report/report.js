/// Shows the map and the picture of a log at the cursor.

const data = JSON.parse(byId("log-data").textContent);
explainTerms();
const map = new BirdsEye(show);
const times = [...data.frames, ...data.events.map((event) => event.at_us), ...data.reigns.flatMap((term) => [term.from_us, term.until_us])];
const [from, until] = times.reduce(([first, last], time) => [Math.min(first, time), Math.max(last, time)], [Infinity, 0]);
const written = (at) => new Date(at / 1000).toISOString().replace("T", " ");
const timeline = new Timeline(show, {
  live: false, time: (at) => written(at).slice(until - from > 86400e6 ? 5 : 11, 19), moment: (at) => `${written(at).slice(0, 23)} UTC`,
});
timeline.colour = colours([...data.scenes.flatMap((scene) => scene.vehicles.map((vehicle) => vehicle.report.node)), ...data.reigns.map((term) => term.leader)]);
text(byId("map-empty"), "The log has no map.");
timeline.cursor = data.frames.at(-1) ?? until;
timeline.draw({ ...data, from, until: Math.max(until, from + 1) });

function show() {
  const at = data.frames.indexOf(timeline.frame);
  const scene = at < 0 ? { places: [], objects: [], vehicles: [] } : arrange(data.scenes[at], data.landmarks, data.scenes[at].now_us, timeline.colour);
  if (map.asTable) places(scene);
  else map.draw(scene);
  const picture = data.pictures.filter(({ at_us }) => at_us <= timeline.cursor).pop() ?? data.pictures[0];
  byId("picture-frame").hidden = !picture;
  if (!picture) return;
  byId("picture").src = `data:image/jpeg;base64,${picture.data}`;
  text(byId("picture-at"), `Camera of ${picture.node}, ${timeline.moment(picture.at_us)}`);
}

show();
