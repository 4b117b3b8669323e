// What an exported page shows: an episode that it plays itself, or recorded ones.

import { FIRST } from "./habits.js";
import { understood } from "./link.js";
import { NavigationWorld } from "./navigation.js";
import { policyFrom } from "./policy.js";
import { Recording } from "./recording.js";
import { Session } from "./session.js";
import { SpreadWorld } from "./spread.js";

const WORLDS = { spread: SpreadWorld, navigation: NavigationWorld };

// The session of a page, and what its address asks for, or null.
export function open(page) {
  if (page.replays) {
    const fresh = new Recording(page.replays, { seed: 0, count: 0 });
    const asked = understood(location.hash, fresh.world, fresh.policy);
    return { session: asked === null ? fresh : new Recording(page.replays, asked, asked.events), asked };
  }
  const world = new WORLDS[page.world.kind](page.world), policy = policyFrom(page.network);
  const asked = understood(location.hash, world, policy);
  const start = asked === null ? { seed: FIRST, count: page.world.num_agents } : { seed: asked.seed, count: asked.count };
  return { session: new Session(world, policy, start, asked?.events ?? []), asked };
}
