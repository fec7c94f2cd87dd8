// Present values by name, and the elements that show them.

/** Values as the server sent them last.
 *
 *  Functions that watch a name are called in the next animation frame after a message, once for
 *  all messages until then; while there is no connection once a second, since ages grow.
 */
export class Store {
  #entries = new Map();
  #watchers = new Map();
  #changed = new Set();
  #samplers = new Set();
  #frame = 0;
  #live = false;

  constructor() {
    setInterval(() => {
      if (!this.#live) this.refresh();
    }, 1000);
  }

  /** Take a message of type `values`. */
  take(message) {
    const now = performance.now();
    for (const [name, [value, age, stale]] of Object.entries(message.values)) {
      this.#entries.set(name, { value, age, stale, at: now });
      if (this.#watchers.has(name)) this.#changed.add(name);
    }
    for (const sampler of this.#samplers) sampler(message);
    this.#schedule();
  }

  /** Say whether the connection is there: without it every value is stale. */
  setLive(live) {
    if (this.#live === live) return;
    this.#live = live;
    this.refresh();
  }

  /** Have all watchers called. */
  refresh() {
    for (const name of this.#watchers.keys()) this.#changed.add(name);
    this.#schedule();
  }

  /** Return the value of a name: `{value, age, stale}`, with its age in microseconds by now. */
  get(name) {
    const entry = this.#entries.get(name);
    if (!entry) return { value: null, age: null, stale: true };
    if (this.#live) return entry;
    const silent = (performance.now() - entry.at) * 1000;
    return { value: entry.value, age: (entry.age ?? 0) + silent, stale: true };
  }

  /** Call a function with the value of a name when it may have changed, and at once. */
  watch(name, show) {
    const all = this.#watchers.get(name) ?? new Set();
    this.#watchers.set(name, all.add(show));
    show(this.get(name));
    return () => {
      all.delete(show);
      if (!all.size) this.#watchers.delete(name);
    };
  }

  /** Call a function with every message of values, also while the page is hidden. */
  sample(take) {
    this.#samplers.add(take);
    return () => this.#samplers.delete(take);
  }

  #schedule() {
    if (!this.#frame && this.#changed.size) this.#frame = requestAnimationFrame(() => this.#show());
  }

  #show() {
    this.#frame = 0;
    for (const name of this.#changed) {
      const shown = this.get(name);
      for (const show of this.#watchers.get(name) ?? []) show(shown);
    }
    this.#changed.clear();
  }
}
