// Samples of several curves over a window of time, at most two in each 1/1200 of it.

const BUCKETS = 1200;

/** Curves with a common time axis.
 *
 *  Of each bucket of time the least and the greatest value of each curve are kept, in the order in
 *  which they came, so a short peak stays visible however long the window is.  `null` is a gap,
 *  `undefined` means that nothing is known of this moment (the line goes on).
 */
export class Curves {
  #buckets = [];

  constructor(count, windowS) {
    this.count = count;
    this.windowS = windowS;
    this.widthS = windowS / BUCKETS;
  }

  /** Take the value of a curve at a Unix time; older ones than the last bucket belong to a history. */
  add(at, curve, value) {
    const index = Math.floor(at / this.widthS);
    const bucket = this.#bucket(index);
    const shown = typeof value === "boolean" ? Number(value) : value;
    bucket.seen[curve] = true;
    if (typeof shown !== "number") return;
    const first = bucket.first[curve];
    if (first === undefined) {
      bucket.first[curve] = bucket.second[curve] = shown;
      return;
    }
    const low = Math.min(first, bucket.second[curve]);
    const high = Math.max(first, bucket.second[curve]);
    if (shown > high) [bucket.first[curve], bucket.second[curve]] = [low, shown];
    else if (shown < low) [bucket.first[curve], bucket.second[curve]] = [high, shown];
  }

  /** Return the arrays that a plot takes: times, then the values of each curve. */
  arrays(until) {
    const oldest = Math.floor((until - this.windowS) / this.widthS);
    const times = [];
    const values = Array.from({ length: this.count }, () => []);
    for (const bucket of this.#buckets) {
      if (bucket.index < oldest) continue;
      const at = bucket.index * this.widthS;
      times.push(at, at + this.widthS / 2);
      for (let curve = 0; curve < this.count; curve += 1) {
        const missing = bucket.seen[curve] ? null : undefined;
        values[curve].push(bucket.first[curve] ?? missing, bucket.second[curve] ?? missing);
      }
    }
    return [times, ...values];
  }

  /** Number of buckets that are kept. */
  get size() {
    return this.#buckets.length;
  }

  /** Forget everything. */
  clear() {
    this.#buckets = [];
  }

  #bucket(index) {
    const buckets = this.#buckets;
    let at = buckets.length;
    while (at && buckets[at - 1].index > index) at -= 1;
    if (at && buckets[at - 1].index === index) return buckets[at - 1];
    const bucket = { index, first: new Array(this.count), second: new Array(this.count), seen: new Array(this.count) };
    buckets.splice(at, 0, bucket);
    // Here, and not when they are drawn: a hidden page draws nothing for days.
    while (buckets[0].index < buckets.at(-1).index - BUCKETS - 1) buckets.shift();
    return bucket;
  }
}

/** Return the seconds of a window such as `10m`. */
export function windowSeconds(text) {
  const [, number, unit] = /^(\d+)([smh])$/.exec(text) ?? [0, 10, "m"];
  return number * { s: 1, m: 60, h: 3600 }[unit];
}
