// Steps the page's worlds and policy from recorded states, and prints how far they are from what JAX did.

import { readFileSync } from "node:fs";

import { NavigationWorld } from "./navigation.js";
import { policyFrom } from "./policy.js";
import { SpreadWorld } from "./spread.js";

const recorded = JSON.parse(readFileSync(process.argv[2], "utf8"));
const world = new { spread: SpreadWorld, navigation: NavigationWorld }[recorded.world.kind](recorded.world);
const policy = policyFrom(recorded.network);
const worst = { positions: 0, velocities: 0, reward: 0, share: 0, collisions: 0, values: 0 };
const wrong = { words: 0, actions: 0, edges: 0 };

function compare(name, ours, theirs) {
  for (let k = 0; k < theirs.length; k++) {
    const apart = Math.abs(ours[k] - theirs[k]);
    worst[name] = Number.isFinite(apart) ? Math.max(worst[name], apart) : Infinity;
  }
}

for (const step of recorded.steps) {
  const state = { ...step.state };
  for (const part of ["positions", "velocities", "landmarks"]) state[part] = Float64Array.from(step.state[part]);
  const seen = world.observe(state, recorded.network.settings.radius);
  const decision = policy.decide(seen);
  compare("values", decision.values.flatMap((row) => [...row]), step.values);
  wrong.words += String(decision.said.flat()) !== String(step.words);
  wrong.actions += String(decision.actions) !== String(step.best);
  const hears = decision.hears.map((speakers) => [...speakers].sort((a, b) => a - b));
  wrong.edges += recorded.network.settings.nearest_agents === null && JSON.stringify(hears) !== JSON.stringify(step.hears);
  const after = world.step(state, step.actions);
  compare("positions", after.state.positions, step.after.positions);
  compare("velocities", after.state.velocities, step.after.velocities);
  for (const measure of ["reward", "share", "collisions"]) compare(measure, [after[measure]], [step.after[measure]]);
}
console.log(JSON.stringify({ steps: recorded.steps.length, worst, wrong }));
