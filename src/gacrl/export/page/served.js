// What a served page shows: an episode that `gacrl view` plays with the real policy. In place of `opening.js`.

import { dressed, shareLit } from "./dressing.js";
import { byId, make, say } from "./elements.js";
import { FIRST } from "./habits.js";
import { drawLearning } from "./learning.js";
import { understood } from "./link.js";
import { MEDDLING, Story } from "./story.js";

const AHEAD = 24;  // frames that are asked for before they are shown
const PACE = 40;  // milliseconds between two messages of a hand that drags
const MOST = 64;  // frames in one message
const SILENCE = 5000;  // milliseconds without an answer after which everything is asked for once more
const AGAIN = 1500;  // milliseconds until a lost server is looked for again

// The session of a page, once its first frame is there, and what its address asks for, or null.
export async function open(page) {
  const { facts } = page, world = { ...facts, add: facts.most > facts.least, remove: facts.most > facts.least };
  const policy = { settings: page.network.settings };
  const asked = understood(location.hash, world, policy);
  const start = asked === null ? { seed: FIRST, count: facts.count } : { seed: asked.seed, count: asked.count };
  const session = new Served(page, world, policy, start, asked?.events ?? []);
  await session.opened;
  return { session, asked };
}

class Served extends Story {
  constructor(page, world, policy, start, events) {
    super(start, events, page.facts.radius);
    Object.assign(this, { page, world, policy, length: world.length, names: page.facts.names, movable: page.facts.movable, reaches: page.facts.radius !== null });
    this.main = { frames: [] };
    this.twin = { frames: [] };
    this.fresh = 0;  // so many frames are of the scene as it is; later ones are on their way
    this.version = 0;
    this.wanted = -1;  // the last step that was asked for
    this.heard = 0;  // when the last frame came, or the first of a row was asked for
    this.paced = null;
    this.line = new Line(this);
    this.opened = new Promise((resolve) => { this.open = resolve; });
  }

  get meddled() {
    return this.names !== null || super.meddled;
  }

  get newest() {
    return Math.min(this.main.frames.length, this.meddled ? this.twin.frames.length : Infinity) - 1;
  }

  ready(t) {
    return t < this.fresh;
  }

  // Step t stays on the page as it was until the server has played what it is now.
  change(t, event) {
    const untouched = !this.meddled;
    this.note(t, event);
    if (event.kind === "move") Object.assign(this.main.frames[t].scene[`${event.thing}s`][event.index] ?? {}, { x: event.x, y: event.y });
    this.main.frames.length = Math.min(this.main.frames.length, t + 1);
    if (untouched) this.twin.frames = this.main.frames.slice();
    const same = this.names === null && MEDDLING.has(event.kind) ? t + 1 : t;
    this.twin.frames.length = Math.min(this.twin.frames.length, Math.max(same, t + 1));
    this.renew(Math.min(this.fresh, t));
  }

  restart(t, seed) {
    const shown = [this.main.frames[t], this.twin.frames[t]];
    this.again(t, seed);
    this.main.frames = [shown[0]];
    this.twin.frames = [shown[1] ?? shown[0]];
    this.renew(0);
  }

  // A new scene of which so many frames are known.
  renew(fresh) {
    this.fresh = fresh;
    this.version += 1;
    this.revision += 1;
    this.length = this.world.length;
    this.paced ??= setTimeout(() => this.tell(), PACE);
  }

  tell() {
    clearTimeout(this.paced);
    this.paced = null;
    this.line.send({ kind: "scene", version: this.version, ...this.start, events: this.events });
    this.wanted = this.fresh - 1;
    this.heard = performance.now();
    this.work(this.fresh);
  }

  // Ask for the frames up to step t, and some more, before they are needed.
  work(t) {
    if (this.paced !== null || !this.line.open) return;
    if (this.fresh <= this.wanted && performance.now() - this.heard > SILENCE) {
      this.tell();
      return;
    }
    if (this.wanted >= Math.min(t + AHEAD / 2, this.length)) return;
    const first = this.wanted + 1, last = Math.min(t + AHEAD, this.length, this.wanted + MOST);
    if (first > last) return;
    if (this.fresh > this.wanted) this.heard = performance.now();
    this.wanted = last;
    this.line.send({ kind: "frames", version: this.version, first, last });
  }

  // A frame from the server; what is of an earlier scene comes too late.
  take({ version, t, main, twin }) {
    if (version !== this.version || t !== this.fresh) return;
    this.main.frames[t] = frameOf(main);
    if (twin !== null) this.twin.frames[t] = frameOf(twin);
    this.fresh = t + 1;
    this.heard = performance.now();
    this.revision += 1;
    if (main.over && (twin === null || twin.over)) this.length = t;
    this.line.tell("");
    this.open();
  }
}

// The socket: it says all again after it was lost.
class Line {
  constructor(session) {
    this.session = session;
    this.notice = make("p", { id: "notice", role: "alert", hidden: true });
    byId("verdict").after(this.notice);
    this.dial();
  }

  get open() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  dial() {
    const address = new URL("live", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.search = location.search;
    address.hash = "";
    this.over = false;
    this.socket = new WebSocket(address);
    this.socket.addEventListener("open", () => {
      this.tell("");
      this.session.renew(0);
      this.session.tell();
    });
    this.socket.addEventListener("message", (message) => this.hear(JSON.parse(message.data)));
    this.socket.addEventListener("close", () => {
      if (this.over) return;
      this.tell("The server does not answer. The page goes on when it is there again.");
      setTimeout(() => this.dial(), AGAIN);
    });
  }

  send(message) {
    if (this.open) this.socket.send(JSON.stringify(message));
  }

  hear(message) {
    const { session } = this;
    if (message.kind === "frame") session.take(message);
    else if (message.kind === "error") {
      this.over = message.over === true;
      this.tell(message.says);
    } else if (message.kind === "learning") {
      session.revision += 1;
      drawLearning(message);
    } else if (message.kind === "known" || message.kind === "words") {
      const { kind, ...found } = message;
      Object.assign(session.page, found);
      session.revision += 1;
    }
  }

  tell(says) {
    say(this.notice, says);
    this.notice.hidden = says === "";
  }
}

// A frame as the page knows it, of what `gacrl.viewer.pictures` wrote: shares are whole percents there.
function frameOf(shown) {
  const agents = discs(shown.agents), marks = discs(shown.marks);
  const decision = {
    said: shown.said, arrived: shown.arrived, hears: shown.hears, actions: shown.actions, values: shown.values,
    heeded: shown.heeded ? [shown.heeded.map((row) => row.map((percent) => percent / 100))] : [],
    wordShares: shown.words?.map((round) => round.map(sparse)),
    looks: agents.map((_, i) => inPairs(shown.looks?.[i] ?? []).map(([index, percent]) => ({ index, share: percent / 100 }))),
  };
  return {
    seen: shown.sees?.map((sees, i) => sightOf(sees, agents[i], agents, marks)),
    scene: { ...dressed(agents, marks, shown.lines, shown.ground), drawn: shown.drawn ?? null }, decision, share: shown.measured.share ?? shareLit(marks),
    totals: { return: shown.earned, collisions: 0, ...shown.measured },
  };
}

function discs({ x, y, radius, there, lit, colour }) {
  return x.map((_, k) => ({ x: x[k], y: y[k], radius: radius[k], there: there[k], lit: lit[k], colour: colour[k] }));
}

// The likeliest words and their chances, each at the place of its symbol.
function sparse(numbers) {
  const shares = [];
  for (const [symbol, percent] of inPairs(numbers)) shares[symbol] = percent / 100;
  return shares;
}

function inPairs(numbers) {
  return Array.from({ length: numbers.length / 2 }, (_, k) => numbers.slice(2 * k, 2 * k + 2));
}

// What one agent sees, as a world's `observe` has it: the nearest things, and how many besides.
function sightOf([landmarks, others, more], { x, y }, agents, marks) {
  const from = (things) => (index) => {
    const offset = { x: things[index].x - x, y: things[index].y - y };
    return { ...offset, index, squared: offset.x ** 2 + offset.y ** 2 };
  };
  return { landmarks: landmarks.map(from(marks)), agents: others.map(from(agents)), more };
}
