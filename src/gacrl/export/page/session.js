// One episode in two lanes that run in lockstep: what the visitor made of it, and the same without meddling in the words.

import { randomNumbers } from "./random.js";
import { edgeName, MEDDLING, Story } from "./story.js";
import { arrivals } from "./words.js";

// The same dice in both lanes, and none of the starts'.
const NEWCOMER = 101;
const ELSEWHERE = 7919;

export class Session extends Story {
  // start: {seed, count}; events: [{at, kind, …}] in the order in which they were done.
  constructor(world, policy, start, events = []) {
    super(start, events, policy.settings.radius);
    this.world = world;
    this.policy = policy;
    this.length = world.length;
    this.reaches = Boolean(world.reaches);
    this.build();
  }

  // The last step that can be shown.
  get newest() {
    return this.length;
  }

  build() {
    this.main = new Lane(this, true, this.start.seed);
    this.twin = new Lane(this, false, this.start.seed);
    this.elsewhere = new Lane(this, false, this.start.seed + ELSEWHERE);
  }

  change(t, event) {
    this.note(t, event);
    this.main.forget(t);
    this.elsewhere.forget(t);
    if (MEDDLING.has(event.kind)) this.twin.forget(t + 1);
    else this.twin.forget(t);
  }

  restart(t, seed) {
    this.again(t, seed);
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
