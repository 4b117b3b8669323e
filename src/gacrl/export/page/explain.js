// Says in words what an agent sees, hears, says and does, and what a word goes with.

import { softmax } from "./numbers.js";
import { colourName, letter } from "./palette.js";
import { FATES } from "./words.js";

const COMPASS = ["to the right", "to the upper right", "above", "to the upper left", "to the left", "to the lower left", "below", "to the lower right", "here"];
const NAMED = 4;  // so many things are listed, the nearest ones

// [[heading, sentence], …] about an agent in a frame of the live page.
export function aboutAgent(frame, index, page, rules) {
  const { decision, seen, scene } = frame, agent = scene.agents[index], lines = [];
  if (agent.there === false) return [["Now", "not there"]];
  if (seen) lines.push(["Sees", sees(seen[index], scene, page.words)]);
  const goal = scene.marks[agent.goal];
  if (goal) lines.push(["Must reach", `${colourName(agent.goal)}, ${far(Math.hypot(goal.x - agent.x, goal.y - agent.y))} away${page.world?.knows ? ", which it does not know" : ""}`]);
  if (!decision) return lines;
  lines.push(["Hears", hears(decision, index)]);
  if (decision.said.length > 0) lines.push(["Says", says(decision, index, rules.fates[index])]);
  const looks = (decision.looks?.[index] ?? []).filter((look) => look.share >= 0.05).sort((a, b) => b.share - a.share).slice(0, NAMED);
  if (looks.length > 0) {
    const at = looks.map((look) => `${percent(look.share)} ${markName(scene, look.index, page.words)}`);
    lines.push(["Then looks at", at.join(", ")]);
  }
  if (decision.actions) {
    const share = page.network?.settings.draws ? actionShares(frame, index).get(decision.actions[index]) : undefined;
    lines.push(["Next", actionName(page, decision.actions[index]) + (share === undefined ? "" : ` (${percent(share)})`)]);
  }
  return lines;
}

// What the head says of each action that an agent has: {action: number}.
export function actionValues({ decision, seen }, index) {
  const allowed = seen?.[index]?.available, has = (value, action) => value !== null && (allowed?.[action] ?? true);
  return new Map([...(decision.values?.[index] ?? [])].map((value, action) => [action, value]).filter(([action, value]) => has(value, action)));
}

// The chance of each action, of a policy that draws: {action: share}.
export function actionShares(frame, index) {
  const values = actionValues(frame, index), shares = softmax([...values.values()]);
  return new Map([...values.keys()].map((action, k) => [action, shares[k]]));
}

function sees(seen, scene, words) {
  const near = (things) => [...things].sort((a, b) => a.squared - b.squared).slice(0, NAMED);
  const name = (thing, what) => `${what} ${towards(thing)}`;
  const marks = near(seen.landmarks).map((it) => name(it, markName(scene, it.index, words)));
  const agents = near(seen.agents).map((it) => name(it, `${words.agent} ${it.index}`));
  const rest = seen.landmarks.length + seen.agents.length + (seen.more ?? 0) - marks.length - agents.length;
  const all = [...marks, ...agents, ...(rest > 0 ? [`${rest} more`] : [])];
  return all.length > 0 ? all.join("; ") : "nothing";
}

function hears(decision, index) {
  const speakers = decision.hears[index] ?? [];
  if (speakers.length === 0) return "nobody";
  const attention = (k) => decision.heeded.reduce((sum, round) => sum + round[index][k], 0) / (decision.heeded.length || 1);
  const ranked = speakers.map((speaker, k) => [speaker, attention(k)]).sort((a, b) => b[1] - a[1]);
  const named = ranked.slice(0, NAMED).map(([speaker, share]) => (decision.heeded.length ? `agent ${speaker} (${percent(share)} of its attention)` : `agent ${speaker}`));
  return named.join(", ") + (ranked.length > NAMED ? ` and ${ranked.length - NAMED} more` : "");
}

function says(decision, index, fate) {
  const words = decision.said.map((round, r) => {
    const share = decision.wordShares?.[r][index][round[index]];
    return round[index] < 0 ? "nothing" : letter(round[index]) + (share === undefined ? "" : ` (${percent(share)})`);
  });
  return words.join(", then ") + (fate ? `; but ${FATES[fate.kind].says}` : "");
}

// A sentence about a word out of the dictionary; null for one that was never recorded.
export function aboutWord(dictionary, agent, round, symbol, page) {
  const entry = dictionary.find((it) => it.round === round && it.symbol === symbol && (it.agent === agent || it.agent < 0));
  if (entry === undefined) return null;
  const who = entry.agent < 0 ? "all agents" : `agent ${entry.agent}`;
  const start = `${letter(symbol)} in round ${round + 1}: ${percent(entry.share)} of what ${who} say${entry.agent < 0 ? "" : "s"} there.`;
  if (!entry.direction) return `${start} Nobody hears it.`;
  const goal = entry.goal[0] >= 0 ? `Who hears it most often has to go to ${colourName(entry.goal[0])} (${percent(entry.goal[1])}). That` : "";
  const place = entry.of === "heard" && goal ? `${goal} lies` : `For who ${entry.of === "heard" ? "hears" : "says"} it the nearest ${page.words.mark} lies`;
  return `${start} ${place} ${COMPASS[entry.direction[0]]} (${percent(entry.direction[1])}), ${far(entry.distance)} away on average; `
    + `the next action is “${actionName(page, entry.action[0])}” (${percent(entry.action[1])}).`;
}

export function markName(scene, index, words) {
  const { colour } = scene.marks[index];
  return colour >= 0 ? colourName(colour) : `${words.mark} ${index}`;
}

export function actionName(page, action) {
  return page.actions[action] ?? `action ${action}`;
}

export function percent(share) {
  return `${Math.round(100 * share)}\u00a0%`;  // no line ends before the sign
}

function far(distance) {
  return distance.toFixed(2);
}

function towards({ x, y }) {
  const distance = Math.hypot(x, y);
  if (distance < 0.1) return "here";
  return `${far(distance)} ${COMPASS[(Math.round(Math.atan2(y, x) / (Math.PI / 4)) + 8) % 8]}`;
}
