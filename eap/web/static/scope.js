// Life of a part of the page: all that it watches ends with it.

/** Subscriptions, timers and children of one view. */
export class Scope {
  #ends = [];

  constructor(app) {
    this.app = app;
  }

  /** Have a function called when the view ends. */
  atEnd(end) {
    this.#ends.push(end);
  }

  /** Show the value of a variable whenever it changes. */
  watch(name, show) {
    this.atEnd(this.app.store.watch(name, show));
  }

  /** Take every message of values. */
  sample(take) {
    this.atEnd(this.app.store.sample(take));
  }

  /** Call a function with the latest message of a type, and with each later one. */
  on(type, show) {
    const event = (each) => show(each.detail);
    this.app.events.addEventListener(type, event);
    this.atEnd(() => this.app.events.removeEventListener(type, event));
    if (this.app.latest[type]) show(this.app.latest[type]);
  }

  /** Listen to events of a browser's object, such as a window. */
  listen(target, type, listener) {
    target.addEventListener(type, listener);
    this.atEnd(() => target.removeEventListener(type, listener));
  }

  /** Call a function again and again. */
  every(ms, call) {
    const timer = setInterval(call, ms);
    this.atEnd(() => clearInterval(timer));
  }

  /** End everything. */
  end() {
    for (const end of this.#ends.splice(0)) end();
  }
}
