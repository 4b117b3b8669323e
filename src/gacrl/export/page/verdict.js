// One sentence on what meddling with the words has done so far.

import { percent } from "./explain.js";
import { FATES } from "./words.js";

export function verdict(page, session, t) {
  const main = session.main.frames[t];
  if (!session.meddled) return t >= session.length ? `The episode is over: return ${main.totals.return.toFixed(1)}.` : "";
  if (session.names !== null) return between(session, t);
  const twin = session.twin.frames[t], rules = session.standing(t), agents = Object.keys(rules.fates).map(Number);
  const all = agents.length >= main.scene.agents.length && agents.length > 1;
  const kinds = [...new Set(Object.values(rules.fates).map((fate) => fate.kind))];
  const who = all ? "Everyone" : agents.length === 1 ? `Agent ${agents[0]}` : `Agents ${agents.join(", ")}`;
  const how = kinds.map((kind) => (kind === "speak" ? "spoken for by you" : FATES[kind].label)).join(" and ");
  const done = agents.length > 0 ? `${who} ${agents.length > 1 && !all ? "are" : "is"} ${how}` : "Who hears whom is changed";
  if (t < 3) return `${done}. Watch both pictures.`;
  const gap = main.totals.return - twin.totals.return, share = (frame) => percent(frame.share);
  const goals = main.scene.marks.length > 0 ? ` ${share(main)} of the ${page.words.mark}s ${page.words.lit}, untouched ${share(twin)}.` : "";
  if (Math.abs(gap) < 0.05) return `${done}: so far nothing has changed.${goals}`;
  return `${done}: ${Math.abs(gap).toFixed(1)} points ${gap < 0 ? "worse" : "better"} than untouched after ${t} steps.${goals}`;
}

// Of two policies side by side: which of them is ahead.
function between({ names, main, twin }, t) {
  const gap = main.frames[t].totals.return - twin.frames[t].totals.return;
  if (t < 3 || Math.abs(gap) < 0.05) return "";
  return `${names.main} is ${Math.abs(gap).toFixed(1)} points ${gap < 0 ? "behind" : "ahead of"} ${names.twin} after ${t} steps.`;
}
