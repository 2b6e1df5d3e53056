// The connection to the node: pictures as they come, history now and then, and word of when nothing comes.

/// A longer silence means that the connection is lost: the node sends at least one picture a second.
const SILENCE_MS = 3000;
/// How often history is asked for, and pictures where they do not come by themselves.
const HISTORY_MS = 2000;

export class Live {
  picture = null;
  history = { reigns: [], samples: [], failovers: 0 };
  landmarks = [];
  refused = false;
  /// Whether the node has no room for another live page; it is then asked now and then.
  crowded = false;
  #source = null;
  #heard = 0;
  /// Whether the node is to tell its whole history: it may be another run.
  #afresh = false;

  constructor(onPicture, onHistory) {
    this.onPicture = onPicture;
    this.onHistory = onHistory;
    document.addEventListener("visibilitychange", () => this.#follow());
    setInterval(() => this.#check(), 500);
    setInterval(() => this.#refresh(), HISTORY_MS);
    this.#follow();
    this.#refresh();
  }

  /// Whether pictures come.
  get connected() {
    return performance.now() - this.#heard < SILENCE_MS + (this.crowded ? HISTORY_MS : 0);
  }

  /// The node's time now, in microseconds, as far as the last picture tells.
  get now() {
    return this.picture ? this.picture.now_us + (performance.now() - this.#heard) * 1000 : 0;
  }

  /// A page that nobody looks at takes no connection.
  #follow() {
    if (document.hidden) return this.#close();
    if (this.#source) return;
    this.#source = new EventSource("/api/events");
    this.#source.addEventListener("picture", (event) => {
      [this.refused, this.crowded] = [false, false];
      this.#take(JSON.parse(event.data));
    });
    this.#source.addEventListener("error", () => this.#ask());
  }

  #take(picture) {
    const restarted = this.picture?.node.started_at_us !== picture.node.started_at_us;
    this.picture = picture;
    this.#heard = performance.now();
    if (restarted) this.#restart();
    this.onPicture();
  }

  /// Whether the browser gave up: the node answered, but not with pictures.
  get #closed() {
    return this.#source?.readyState === EventSource.CLOSED;
  }

  async #ask() {
    const picture = this.#closed && (await this.#get("/api/picture"));
    this.crowded = this.#closed && Boolean(picture);
    if (this.crowded) this.#take(picture);
  }

  #close() {
    this.#source?.close();
    this.#source = null;
  }

  /// A browser does not notice every lost connection.
  #check() {
    const silent = performance.now() - this.#heard > 2 * SILENCE_MS;
    if (!document.hidden && silent && this.picture && Math.random() < 0.1) {
      this.#close();
      this.#follow();
    }
    this.onPicture();
  }

  async #restart() {
    this.#afresh = true;
    this.landmarks = (await this.#get("/api/landmarks")) ?? this.landmarks;
    this.#refresh();
  }

  async #refresh() {
    if (document.hidden) return;
    if (this.#closed) {
      this.#close();
      this.#follow();
    }
    // What is known is shown until there is other: the node may end before it has told.
    const known = this.#afresh ? [] : this.history.samples;
    const since = known.at(-1)?.at_us ?? 0;
    const news = await this.#get(`/api/history?since=${since}`);
    if (!news) return;
    this.#afresh = false;
    const samples = [...known, ...news.samples.filter((sample) => sample.at_us > since)].slice(-300);
    this.history = { ...news, samples };
    this.onHistory();
  }

  async #get(path) {
    try {
      const answer = await fetch(path);
      this.refused = answer.status === 401;
      return answer.ok ? await answer.json() : null;
    } catch {
      return null;
    }
  }
}
