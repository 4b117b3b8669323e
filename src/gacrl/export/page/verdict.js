// One sentence on what meddling with the words has done so far.

import { percent } from "./explain.js";
import { FATES } from "./words.js";

export function verdict(page, session, t) {
  const main = session.main.frames[t];
  if (!session.meddled) return t >= session.length ? `The episode is over: return ${main.totals.return.toFixed(1)}.` : "";
  if (session.names !== null) return between(session, t);
  const twin = session.twin.frames[t], done = meddledWith(session, t);
  if (t < 3) return `${done}. Watch both pictures.`;
  const gap = main.totals.return - twin.totals.return, goals = main.scene.marks.length > 0 ? ` ${reached(page, main, twin)}` : "";
  if (Math.abs(gap) < 0.05) return `${done}: so far nothing has changed.${goals}`;
  return `${done}: ${Math.abs(gap).toFixed(1)} points ${gap < 0 ? "worse" : "better"} than untouched after ${t} steps.${goals}`;
}

// What was done to whose words, as a picture is headed.
export function meddledWith(session, t) {
  const rules = session.standing(t), agents = Object.keys(rules.fates).map(Number);
  if (agents.length === 0) return "Who hears whom is changed";
  const all = agents.length >= session.main.frames[t].scene.agents.length && agents.length > 1;
  const kinds = [...new Set(Object.values(rules.fates).map((fate) => fate.kind))];
  const who = all ? "Everyone" : agents.length === 1 ? `Agent ${agents[0]}` : `Agents ${agents.join(", ")}`;
  const how = kinds.map((kind) => (kind === "speak" ? "spoken for by you" : FATES[kind].label)).join(" and ");
  return `${who} ${agents.length > 1 && !all ? "are" : "is"} ${how}`;
}

// How many agents are where they have to go; of agents without goals of their own, which share of the marks is lit.
function reached(page, main, twin) {
  const seekers = main.scene.agents.filter((agent) => agent.there !== false && agent.goal >= 0).length;
  if (seekers === 0) return `${percent(main.share)} of the ${page.words.mark}s ${page.words.lit}, untouched ${percent(twin.share)}.`;
  const count = (frame) => Math.round(frame.share * seekers);
  return `Where they have to be: ${count(main)} of ${seekers} ${page.words.agent}s, untouched ${count(twin)} of ${seekers}.`;
}

// Of two policies side by side: which of them is ahead.
function between({ names, main, twin }, t) {
  const gap = main.frames[t].totals.return - twin.frames[t].totals.return;
  if (t < 3 || Math.abs(gap) < 0.05) return "";
  return `${names.main} is ${Math.abs(gap).toFixed(1)} points ${gap < 0 ? "behind" : "ahead of"} ${names.twin} after ${t} steps.`;
}
