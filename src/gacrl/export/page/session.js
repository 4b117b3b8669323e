// One episode in two lanes that run in lockstep: what the visitor made of it, and the same without meddling in the words.
// A session is a seed, a number of agents, and what was done at which step: it can be scrubbed, rewound and linked to.

import { randomNumbers } from "./random.js";
import { arrivals } from "./words.js";

// What is done to words and edges; everything else (moves, newcomers) happens in both lanes.
const MEDDLING = new Set(["fate", "radius", "cut"]);

// The same dice in both lanes, and none of the starts'.
const NEWCOMER = 101;
const ELSEWHERE = 7919;

export class Session {
  // start: {seed, count}; events: [{at, kind, …}] in the order in which they were done.
  constructor(world, policy, start, events = []) {
    this.world = world;
    this.policy = policy;
    this.start = start;
    this.events = events;
    this.length = world.length;
    this.radius = policy.settings.radius;
    this.build();
  }

  build() {
    this.main = new Lane(this, true, this.start.seed);
    this.twin = new Lane(this, false, this.start.seed);
    this.elsewhere = new Lane(this, false, this.start.seed + ELSEWHERE);
  }

  get meddled() {
    return this.events.some((event) => MEDDLING.has(event.kind));
  }

  // What holds at step t: {fates, radius, cuts, count}.
  standing(t) {
    const rules = { fates: {}, radius: this.radius, cuts: new Set(), count: this.start.count };
    for (const event of this.events) {
      if (event.at > t) continue;
      if (event.kind === "fate" && event.fate === null) delete rules.fates[event.agent];
      else if (event.kind === "fate") rules.fates[event.agent] = event.fate;
      else if (event.kind === "radius") rules.radius = event.value;
      else if (event.kind === "cut" && event.on) rules.cuts.add(edgeName(event.a, event.b));
      else if (event.kind === "cut") rules.cuts.delete(edgeName(event.a, event.b));
      else if (event.kind === "add") rules.count += 1;
      else if (event.kind === "remove") rules.count -= 1;
    }
    return rules;
  }

  // Do something at step t; whatever was to come is forgotten. A thing that is dragged has one place in each step.
  change(t, event) {
    const same = (other) => other.at === t && other.kind === "move" && event.kind === "move"
      && other.thing === event.thing && other.index === event.index;
    this.events = this.events.filter((other) => other.at <= t && !same(other));
    this.events.push({ at: t, ...event });
    this.main.forget(t);
    this.elsewhere.forget(t);
    if (MEDDLING.has(event.kind)) this.twin.forget(t + 1);
    else this.twin.forget(t);
  }

  // The same start again, or another one: what holds at step t holds from the beginning.
  restart(t, seed = this.start.seed) {
    const rules = this.standing(t), events = [];
    for (const [agent, fate] of Object.entries(rules.fates)) events.push({ at: 0, kind: "fate", agent: Number(agent), fate });
    if (rules.radius !== this.radius) events.push({ at: 0, kind: "radius", value: rules.radius });
    for (const edge of rules.cuts) {
      const [a, b] = edge.split("-").map(Number);
      events.push({ at: 0, kind: "cut", a, b, on: true });
    }
    this.start = { seed, count: rules.count };
    this.events = events;
    this.build();
  }

  // Whether step t can be shown.
  ready(t) {
    return this.main.frames.length > t && (!this.meddled || this.twin.frames.length > t);
  }

  // Compute up to step t, for so many milliseconds at the most; the lanes take turns.
  work(t, milliseconds = Infinity) {
    const end = performance.now() + milliseconds;
    while (!this.ready(t)) {
      const behind = this.meddled && this.twin.frames.length < this.main.frames.length ? this.twin : this.main;
      behind.work();
      if (performance.now() > end) return;
    }
  }
}

class Lane {
  // meddled: whether what is done to words is done here.
  constructor(session, meddled, seed) {
    this.session = session;
    this.meddled = meddled;
    this.seed = seed;
    this.frames = [];
    this.underWay = null;
  }

  forget(t) {
    this.frames.length = Math.min(this.frames.length, t);
    this.underWay = null;
  }

  // A part of the next frame.
  work() {
    this.underWay ??= this.next();
    const { done, value } = this.underWay.next();
    if (!done) return;
    this.frames.push(value);
    this.underWay = null;
  }

  through(t) {
    while (this.frames.length <= t) this.work();
    return this.frames[t];
  }

  // The moment before step t: where everything is, what is said about it, and what was earned so far.
  *next() {
    const { world, policy, start } = this.session, t = this.frames.length;
    const rules = this.session.standing(t), before = this.frames[t - 1];
    const stepped = before === undefined
      ? { state: world.reset(this.seed, start.count), reward: 0, collisions: 0 }
      : world.step(before.state, before.decision.actions);
    const state = this.session.events.filter((event) => event.at === t).reduce((at, event) => this.edited(at, event), stepped.state);
    const seen = world.observe(state, this.meddled ? rules.radius : this.session.radius);
    const { arriving, reaches } = this.meddled ? this.onTheWay(rules, t) : {};
    const decision = yield* policy.deciding(seen, arriving, reaches);
    return {
      state, seen, decision, scene: world.look(state), share: world.measure(state).share,
      totals: {
        return: (before?.totals.return ?? 0) + stepped.reward,
        collisions: (before?.totals.collisions ?? 0) + stepped.collisions,
      },
    };
  }

  onTheWay(rules, t) {
    const scrambled = Object.values(rules.fates).some((fate) => fate.kind === "scramble");
    const other = scrambled ? this.session.elsewhere.through(t).decision.said : null;
    const { arriving, reaches } = arrivals(rules.fates, t, (k) => this.frames[k].decision.said, other, this.seed);
    const uncut = (i, j) => !rules.cuts.has(edgeName(i, j));
    return { arriving, reaches: reaches === undefined ? uncut : (i, j) => uncut(i, j) && reaches(i, j) };
  }

  // The state after something was moved, added or taken away.
  edited(state, event) {
    const { world } = this.session;
    if (event.kind === "add") return world.add(state, randomNumbers(this.seed, event.at, NEWCOMER, state.positions.length));
    if (event.kind === "remove") return world.remove(state);
    if (event.kind !== "move") return state;
    const name = event.thing === "agent" ? "positions" : "landmarks", places = state[name].slice();
    if (2 * event.index >= places.length) return state;
    places.set([event.x, event.y], 2 * event.index);
    if (event.thing !== "agent") return { ...state, [name]: places };
    const velocities = state.velocities.slice();
    velocities.fill(0, 2 * event.index, 2 * event.index + 2);
    return { ...state, positions: places, velocities };
  }
}

// Both directions between two agents.
export function edgeName(a, b) {
  return a < b ? `${a}-${b}` : `${b}-${a}`;
}
