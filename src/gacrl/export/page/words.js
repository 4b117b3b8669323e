// What happens to words on their way, as `gacrl.messages.interventions`: silence, swap, scramble, delay, drop, and a voice
// of one's own. A fate is what happens to the words of one agent: {kind, value}.

import { randomNumbers } from "./random.js";

export const FATES = {
  silence: { label: "silenced", says: "nobody hears it" },
  swap: { label: "swapped", says: "it is heard with another agent's words" },
  scramble: { label: "scrambled", says: "it is heard with its words from another episode" },
  delay: { label: "late", says: "its words arrive three steps late" },
  drop: { label: "half lost", says: "each listener misses half of what it says" },
  speak: { label: "you", says: "you speak in its place" },
};
export const LATE = 3;
const LOST = 0.5;

// What arrives in step t. fates: {agent: {kind, value}}; said(t): the words [R][N] of a step of this episode;
// elsewhere: the words [R][N] of this step in another episode, or null.
export function arrivals(fates, t, said, elsewhere, seed) {
  const cursed = Object.entries(fates).map(([agent, fate]) => [Number(agent), fate]);
  if (cursed.length === 0) return {};
  const late = t >= LATE && cursed.some(([, fate]) => fate.kind === "delay") ? said(t - LATE) : null;

  function arriving(round, words) {
    const arrives = [...words];
    for (const [agent, { kind, value }] of cursed) {
      if (agent >= words.length) continue;
      if (kind === "swap") arrives[agent] = words[value] ?? words[agent];
      if (kind === "scramble") arrives[agent] = elsewhere?.[round][agent] ?? words[agent];
      if (kind === "delay" && late !== null) arrives[agent] = late[round][agent] ?? words[agent];
      if (kind === "speak") arrives[agent] = value[round];
    }
    return arrives;
  }

  function reaches(listener, speaker) {
    const fate = fates[speaker];
    if (fate === undefined) return true;
    if (fate.kind === "silence") return false;
    if (fate.kind === "delay") return t >= LATE;
    return fate.kind !== "drop" || randomNumbers(seed, t, listener, speaker)() >= LOST;
  }

  return { arriving, reaches };
}
