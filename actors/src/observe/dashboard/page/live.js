// Connection to the node: live snapshots, polled history, and detection of a lost connection.

/// Silence after which the connection counts as lost: the node sends at least one snapshot a second.
const SILENCE_MS = 3000;
/// Polling period of the history, and of snapshots where the node sends none.
const HISTORY_MS = 2000;
/// Time that the node holds, in microseconds.
export const SPAN_US = 600e6;

export class Live {
  picture = null;
  history = { reigns: [], samples: [], events: [], frames: [], failovers: 0 };
  landmarks = [];
  refused = false;
  /// Whether the node has no room for another live page, so that this one polls.
  crowded = false;
  #source = null;
  #heard = 0;
  /// Whether to fetch the whole history, as after a restart of the node.
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

  /// Whether snapshots arrive.
  get connected() {
    return performance.now() - this.#heard < SILENCE_MS + (this.crowded ? HISTORY_MS : 0);
  }

  /// The node's present time in microseconds, from the last snapshot.
  get now() {
    return this.picture ? this.picture.now_us + (performance.now() - this.#heard) * 1000 : 0;
  }

  /// A hidden page keeps no connection.
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

  /// Whether the browser gave up: the node answered without snapshots.
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

  /// Reconnects after a long silence, since a browser does not notice every lost connection.
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
    // The old history stays until the new one arrives: the node may end before that.
    const known = this.#afresh ? { samples: [], events: [] } : this.history;
    const since = known.samples.at(-1)?.at_us ?? 0;
    const news = await this.#get(`/api/history?since=${since}`);
    if (!news) return;
    this.#afresh = false;
    const [samples, events] = ["samples", "events"].map((name) => {
      const last = known[name].at(-1)?.at_us ?? 0;
      return [...known[name], ...news[name].filter(({ at_us }) => at_us > last)].filter(({ at_us }) => at_us > this.now - SPAN_US);
    });
    this.history = { ...news, samples, events };
    this.onHistory();
  }

  /// The map that was the newest at a time, as part of a snapshot; null if the node does not answer.
  frame(at) {
    return this.#get(`/api/frame?at=${at}`);
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
