// Plays episodes from recorded starts while something happens to words, and prints how far they are from JAX's.

import { readFileSync } from "node:fs";

import { understood, written } from "./link.js";
import { NavigationWorld } from "./navigation.js";
import { policyFrom } from "./policy.js";
import { Session } from "./session.js";

const recorded = JSON.parse(readFileSync(process.argv[2], "utf8"));
const policy = policyFrom(recorded.network), found = {};

class Recorded extends NavigationWorld {
  reset() {
    return this.start;
  }
}

for (const [name, episode] of Object.entries(recorded.episodes)) {
  const world = new Recorded(recorded.world);
  world.start = { ...episode.start };
  for (const part of ["positions", "velocities", "landmarks"]) world.start[part] = Float64Array.from(episode.start[part]);
  const session = new Session(world, policy, { seed: 0, count: world.most });
  for (const [agent, fate] of Object.entries(episode.fates)) session.change(0, { kind: "fate", agent: Number(agent), fate });
  session.work(session.length);
  const frames = session.main.frames, places = frames.flatMap((frame) => [...frame.state.positions]);
  const link = written(session.start, session.events, 3);
  found[name] = {
    apart: Math.max(...places.map((place, k) => Math.abs(place - episode.positions[k]))),
    words: frames.slice(0, -1).filter((frame, t) => String(frame.decision.said.flat()) !== String(episode.words[t])).length,
    touched: frames.some((frame, t) => session.meddled && String(frame.state.positions) !== String(session.twin.frames[t].state.positions)),
    linked: JSON.stringify(understood(link, world, policy).events) === JSON.stringify(session.events),
  };
}
console.log(JSON.stringify(found));
