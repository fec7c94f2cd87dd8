// Connection to the server: requests, and the WebSocket, which connects again by itself.

const API = "api/v1";
const SILENT_MS = 6000; // the plant's overview comes once a second
const PAUSES_MS = [300, 1000, 2000, 3000];

/** Refusal of a request, in words of the server. */
export class Refusal extends Error {
  constructor(status, message) {
    super(message);
    this.status = status;
  }
}

/** One server.
 *
 *  Listeners: `onState(state)` with `connecting`, `open`, `lost` or `login`; `onSession(session)`
 *  before each connection; `onMessage(message)`.
 */
export class Connection {
  session = null;
  state = "connecting";
  #socket = null;
  #topics = [];
  #failures = 0;
  #timer = 0;
  #watchdog = 0;

  constructor({ onState, onSession, onMessage }) {
    this.onState = onState;
    this.onSession = onSession;
    this.onMessage = onMessage;
    const again = () => {
      if (!document.hidden && this.state === "lost") this.connect();
    };
    addEventListener("online", again);
    document.addEventListener("visibilitychange", again);
  }

  /** Connect, now. */
  async connect() {
    clearTimeout(this.#timer);
    this.#drop();
    if (this.state === "open") this.#set("connecting");
    const attempt = (this.#socket = {});
    try {
      const session = await this.get("session");
      if (this.#socket !== attempt) return;
      await this.onSession(session, this.session);
      this.session = session;
    } catch (error) {
      if (this.#socket === attempt) this.#lose(error);
      return;
    }
    if (this.#socket !== attempt) return;
    if (!this.session.role) {
      this.#set("login");
      return;
    }
    this.#open();
  }

  /** Have these topics, and no others, sent. */
  subscribe(topics) {
    this.#topics = topics;
    if (this.state === "open") this.#socket.send(JSON.stringify({ subscribe: topics }));
  }

  /** Return the answer to a GET request; raise Refusal if it has no success. */
  async get(path) {
    return this.#answer(await fetch(`${API}/${path}`, { signal: AbortSignal.timeout(10_000) }));
  }

  /** Return the answer to a change; raise Refusal if it is refused. */
  async post(path, body) {
    const headers = { "Content-Type": "application/json", "X-CSRF-Token": this.session?.csrf ?? "" };
    const request = { method: "POST", headers, body: JSON.stringify(body), signal: AbortSignal.timeout(10_000) };
    return this.#answer(await fetch(`${API}/${path}`, request));
  }

  async #answer(response) {
    const body = await response.json().catch(() => ({}));
    if (!response.ok) throw new Refusal(response.status, body.error?.message ?? response.statusText);
    return body;
  }

  #open() {
    const socket = new WebSocket(new URL(`${API}/ws`, location).href.replace(/^http/, "ws"));
    this.#socket = socket;
    this.#watch();
    socket.onmessage = (event) => {
      if (this.#socket !== socket) return;
      this.#watch();
      const message = JSON.parse(event.data);
      if (message.type === "welcome") {
        this.#failures = 0;
        this.#set("open");
        this.subscribe(this.#topics);
      }
      this.onMessage(message);
    };
    socket.onclose = () => {
      if (this.#socket === socket) this.#lose();
    };
  }

  #watch() {
    clearTimeout(this.#watchdog);
    this.#watchdog = setTimeout(() => this.#lose(), SILENT_MS);
  }

  #lose(error) {
    this.#drop();
    this.#set("lost");
    const pause = PAUSES_MS[Math.min(this.#failures, PAUSES_MS.length - 1)];
    const wait = error instanceof Refusal && error.status === 429 ? 10_000 : pause;
    this.#failures += 1;
    // Many browsers that lost one server do not all come back at the same moment.
    this.#timer = setTimeout(() => this.connect(), wait * (0.8 + 0.4 * Math.random()));
  }

  #drop() {
    clearTimeout(this.#watchdog);
    const socket = this.#socket;
    this.#socket = null;
    if (socket instanceof WebSocket) socket.close();
  }

  #set(state) {
    if (this.state === state) return;
    this.state = state;
    this.onState(state);
  }
}
