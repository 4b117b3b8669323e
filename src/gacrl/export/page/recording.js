// Recorded episodes under the controls of a session: for tasks and networks that the page cannot step itself.

import { dressed, shareLit } from "./dressing.js";

const NUMBERS = { float32: Float32Array, int16: Int16Array };

export class Recording {
  // replays: what `gacrl.export.replays` wrote, {played, silenced}; silenced is empty where nobody speaks.
  constructor(replays, start, events = []) {
    this.episodes = replays.played.map(framesOf);
    this.silences = replays.silenced.map(framesOf);
    const count = this.episodes[0][0].scene.agents.length;
    this.world = { least: count, most: count, length: Math.max(...this.episodes.map((frames) => frames.length - 1)) };
    this.policy = { settings: { rounds: 0, vocabulary: 0 } };
    this.movable = this.reaches = false;
    this.names = null;
    this.start = start;
    this.events = events.filter((event) => event.kind === "fate");
  }

  get number() {
    return this.start.seed % this.episodes.length;
  }

  get length() {
    return this.episodes[this.number].length - 1;
  }

  get newest() {
    return this.length;
  }

  get meddled() {
    return this.silences.length > 0 && Object.keys(this.standing(Infinity).fates).length > 0;
  }

  get main() {
    return { frames: this.meddled ? this.silences[this.number] : this.episodes[this.number] };
  }

  get twin() {
    return { frames: this.episodes[this.number] };
  }

  // All are silenced, or nobody is: nothing else was recorded.
  standing() {
    const silent = this.events.at(-1)?.fate ?? null, fates = {};
    if (silent !== null) this.episodes[0][0].scene.agents.forEach((_, agent) => { fates[agent] = { kind: "silence" }; });
    return { fates, radius: null, cuts: new Set(), count: this.world.most };
  }

  change(t, event) {
    if (event.kind === "fate") this.events = [{ at: 0, ...event }];
  }

  restart(t, seed = this.start.seed) {
    this.start = { ...this.start, seed };
  }

  ready() {
    return true;
  }

  work() {}
}

// What is to be seen in each step of a recorded episode, as a session has it.
export function framesOf(replay) {
  const parts = { agents: discs(replay.agents), marks: discs(replay.marks) };
  const words = replay.words && numbers(replay.words), hears = replay.hears && numbers(replay.hears);
  const reward = numbers(replay.reward).values, ground = [...numbers(replay.ground).values];
  const lines = rowsOf(numbers(replay.lines).values, 4), actions = replay.actions && numbers(replay.actions);
  let earned = 0;
  return Array.from({ length: replay.steps + 1 }, (_, t) => {
    if (t > 0) earned += reward[t - 1];
    const now = Math.min(t, replay.steps - 1);
    const scene = dressed(parts.agents(t), parts.marks(t), lines, ground);
    return {
      scene, totals: { return: earned, collisions: 0 }, share: shareLit(scene.marks),
      decision: decisionOf(now, scene.agents.length, words, hears, actions),
    };
  });
}

function decisionOf(t, count, words, hears, actions) {
  const everyone = Array.from({ length: count }, (_, i) => i);
  const rounds = words ? words.shape[1] : 0;
  const speakers = everyone.map((i) => everyone.filter((j) => hears && hears.values[(t * count + i) * count + j]));
  const said = Array.from({ length: rounds }, (_, r) => everyone.map((i) => words.values[(t * rounds + r) * count + i]));
  return {
    said, arrived: said,
    hears: speakers, heeded: [], looks: everyone.map(() => []),
    actions: actions && everyone.map((i) => actions.values[t * count + i]),
  };
}

function discs(group) {
  const [positions, radius, there, lit, colour] = ["positions", "radius", "there", "lit", "colour"].map((name) => numbers(group[name]).values);
  const count = numbers(group.radius).values.length;
  return (t) => Array.from({ length: count }, (_, k) => ({
    x: positions[2 * (t * count + k)], y: positions[2 * (t * count + k) + 1], radius: radius[k],
    there: Boolean(there[t * count + k]), lit: Boolean(lit[t * count + k]), colour: colour[t * count + k],
  }));
}

// {shape, values} of an array that was written as base64.
function numbers({ shape, kind, data }) {
  const bytes = Uint8Array.from(atob(data), (sign) => sign.charCodeAt(0));
  if (kind !== "bits") return { shape, values: new NUMBERS[kind](bytes.buffer) };
  const size = shape.reduce((product, length) => product * length, 1);
  return { shape, values: Uint8Array.from({ length: size }, (_, k) => (bytes[k >> 3] >> (k & 7)) & 1) };
}

function rowsOf(values, width) {
  return Array.from({ length: values.length / width }, (_, k) => [...values.subarray(k * width, (k + 1) * width)]);
}
