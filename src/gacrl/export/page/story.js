// An episode as a seed, a number of agents, and what was done at which step: it can be scrubbed, rewound and linked to.
// Who inherits it knows how its frames come about.

// What is done to words and edges; everything else (moves, newcomers) happens in the untouched run as well.
export const MEDDLING = new Set(["fate", "radius", "cut"]);

export class Story {
  // start: {seed, count}; events: [{at, kind, …}] in the order in which they were done; radius: where nobody changed it.
  constructor(start, events, radius) {
    this.start = start;
    this.events = events;
    this.radius = radius;
    this.movable = true;  // whether a hand can drag things
    this.reaches = false;  // whether agents hear each other within a radius
    this.names = null;  // of two policies side by side: {main, twin}
    this.revision = 0;  // rises whenever there is something to say anew
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

  // Take down what is done at step t; whatever was to come is forgotten. A thing that is dragged has one place in each step.
  note(t, event) {
    const same = (other) => other.at === t && other.kind === "move" && event.kind === "move"
      && other.thing === event.thing && other.index === event.index;
    this.events = this.events.filter((other) => other.at <= t && !same(other));
    this.events.push({ at: t, ...event });
  }

  // The same start again, or another one: what holds at step t holds from the beginning.
  again(t, seed = this.start.seed) {
    const rules = this.standing(t), events = [];
    for (const [agent, fate] of Object.entries(rules.fates)) events.push({ at: 0, kind: "fate", agent: Number(agent), fate });
    if (rules.radius !== this.radius) events.push({ at: 0, kind: "radius", value: rules.radius });
    for (const edge of rules.cuts) {
      const [a, b] = edge.split("-").map(Number);
      events.push({ at: 0, kind: "cut", a, b, on: true });
    }
    this.start = { seed, count: rules.count };
    this.events = events;
  }
}

// Both directions between two agents.
export function edgeName(a, b) {
  return a < b ? `${a}-${b}` : `${b}-${a}`;
}
