// The page: one session, what is chosen and where it stands, and a loop that draws.

import { connect } from "./controls.js";
import { byId, make, say } from "./elements.js";
import { aboutWord } from "./explain.js";
import { drawCurves, drawGauges } from "./gauges.js";
import { NORMAL, SPEEDS } from "./habits.js";
import { Inspector } from "./inspector.js";
import { written } from "./link.js";
import { open } from "./opening.js";
import { theme } from "./palette.js";
import { areaOf, SceneView } from "./scene.js";
import { edgeName } from "./story.js";
import { meddledWith, verdict } from "./verdict.js";
import { Voices } from "./voices.js";

const WORK = 7;  // milliseconds of each frame for steps to come
const REST = 1800;  // milliseconds between an episode and the next one

const page = JSON.parse(byId("data").textContent);
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
const still = { t: 0, playing: false, speed: NORMAL, selected: null, hovered: null, held: null, over: 0 };

const { session, asked } = await open(page);
const view = new SceneView(byId("scene"), page.colours), twinView = new SceneView(byId("twin"), page.colours);

// The step that is shown: computed by now, or the last one that is.
function now() {
  return Math.min(Math.floor(still.t), session.newest);
}

function settle() {
  session.work(now());
}

function changed(event) {
  settle();
  still.over = 0;
  still.t = now();
  session.change(now(), event);
  settle();
  remember();
}

const act = {
  toggle() {
    if (!still.playing && now() >= session.length) act.rewind();
    still.playing = !still.playing;
    remember();
  },
  step(by) {
    act.seek(now() + by);
  },
  seek(t) {
    still.playing = false;
    still.t = Math.max(0, Math.min(t, session.length));
    remember();
  },
  rewind() {
    session.restart(now());
    begin();
  },
  fresh() {
    session.restart(now(), session.start.seed + 1);
    begin();
  },
  speed(steps) {
    still.speed = steps;
  },
  faster(by) {
    const place = SPEEDS.indexOf(still.speed) + by;
    if (place in SPEEDS) byId("speed").value = String(still.speed = SPEEDS[place]);
  },
  add() {
    if (session.world.add && session.standing(now()).count < session.world.most) changed({ kind: "add" });
  },
  remove() {
    if (session.world.remove && session.standing(now()).count > session.world.least) changed({ kind: "remove" });
  },
  select(thing) {
    still.selected = thing;
  },
  next(thing) {
    const things = session.main.frames[now()].scene[thing === "agent" ? "agents" : "marks"], chosen = still.selected;
    if (things.length > 0) act.select({ thing, index: chosen?.thing === thing ? (chosen.index + 1) % things.length : 0 });
  },
  fate(agents, fate) {
    for (const agent of agents) changed({ kind: "fate", agent, fate });
  },
  // One agent with the next one, all in a ring.
  swap(agents) {
    const count = session.standing(now()).count, other = (agent) => (agent + 1) % count;
    if (agents.length > 1) return agents.forEach((agent) => act.fate([agent], { kind: "swap", value: other(agent) }));
    act.fate(agents, { kind: "swap", value: other(agents[0]) });
    return act.fate([other(agents[0])], { kind: "swap", value: agents[0] });
  },
  silence(everyone) {
    const { count, fates } = session.standing(now());
    const agents = everyone ? Array.from({ length: count }, (_, i) => i) : [chosenAgent()];
    const silent = agents.every((agent) => fates[agent]?.kind === "silence");
    act.fate(agents, silent ? null : { kind: "silence" });
  },
  // The first thing to try: everyone silent from the start, or as before.
  hush() {
    act.silence(true);
    act.rewind();
    still.playing = true;
  },
  radius(value) {
    changed({ kind: "radius", value });
  },
  cut(a, b) {
    if (a !== b) changed({ kind: "cut", a, b, on: !session.standing(now()).cuts.has(edgeName(a, b)) });
    act.chooseEdge();
  },
  chooseEdge() {
    const name = edgeName(Number(byId("cut-a").value), Number(byId("cut-b").value));
    say(byId("cut"), session.standing(now()).cuts.has(name) ? "Mend" : "Cut");
  },
  nearest(x, y, reach) {
    const { agents, marks } = session.main.frames[now()].scene;
    const near = (things, thing) => things.map((it, index) => ({ thing, index, far: Math.hypot(it.x - x, it.y - y) / Math.max(it.radius, 0.06), there: it.there }));
    const [best] = [...near(agents, "agent"), ...near(marks, "mark")].filter((it) => it.there !== false && it.far < reach).sort((a, b) => a.far - b.far);
    return best === undefined ? null : { thing: best.thing, index: best.index };
  },
  grab(thing) {
    if (session.movable) still.held = { ...thing, moved: false };
  },
  drag(x, y, word) {
    if (still.held === null) return act.hover(word ?? act.nearest(x, y, 1.2));
    still.held.moved = true;
    return changed({ kind: "move", thing: still.held.thing, index: still.held.index, x, y });
  },
  drop() {
    still.held = null;
  },
  nudge(dx, dy) {
    if (!session.movable || still.selected === null) return;
    const { thing, index } = still.selected, it = session.main.frames[now()].scene[thing === "agent" ? "agents" : "marks"][index];
    if (it) changed({ kind: "move", thing, index, x: it.x + dx, y: it.y + dy });
  },
  // What a word goes with stands in the picture while the pointer is over it.
  hover(thing) {
    still.hovered = thing;
    const about = thing?.symbol === undefined ? null : aboutWord(page.dictionary, thing.index, thing.round, thing.symbol, page);
    byId("word").hidden = about === null;
    byId("word").classList.toggle("above", about !== null && thing.y > view.size / 2);  // not over the word
    say(byId("word"), about ?? "");
    view.canvas.style.cursor = thing === null ? "default" : session.movable ? "grab" : "pointer";
  },
  copy() {
    write();
    const copied = navigator.clipboard?.writeText(location.href) ?? Promise.reject(new Error("no clipboard"));
    copied.then(() => say(byId("copied"), "copied"), () => say(byId("copied"), "copy it from the address bar"));
  },
};

function begin() {
  still.t = 0;
  still.over = 0;
  settle();
  remember();
}

function chosenAgent() {
  const chosen = still.hovered?.thing === "agent" ? still.hovered : still.selected?.thing === "agent" ? still.selected : { index: 0 };
  return Math.min(chosen.index, session.main.frames[now()].scene.agents.length - 1);
}

// The address follows, but not at every frame.
let writing = null;
function remember() {
  writing ??= setTimeout(write, 300);
}

function write() {
  clearTimeout(writing);
  writing = null;
  history.replaceState(null, "", `#${written(session.start, session.events, now())}`);
}

// Time passes: one step after another, as far as they are computed.
function advance(milliseconds) {
  session.work(Math.min(Math.floor(still.t) + 1, session.length), WORK);
  if (!still.playing) return;
  if (now() >= session.length) {
    still.over += milliseconds;
    if (still.over > REST) act.fresh();
    return;
  }
  const wanted = still.t + (milliseconds / 1000) * still.speed;
  const reachable = session.ready(now() + 1) ? Math.min(wanted, now() + (session.ready(now() + 2) ? 2 : 1)) : still.t;
  still.t = Math.min(reachable, session.length);
  if (now() === session.length) remember();
}

let colours = theme();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { colours = theme(); });

function draw() {
  settle();
  const t = now(), rules = session.standing(t), meddled = session.meddled;
  const selected = still.hovered ?? still.selected ?? null;
  byId("right").hidden = !meddled;
  say(byId("left-name"), session.names?.main ?? (meddled ? meddledWith(session, t) : ""));
  if (session.names !== null) say(byId("right-name"), session.names.twin);
  const lanes = [session.main, ...(meddled ? [session.twin] : [])];
  const area = areaOf(lanes.flatMap((lane) => lane.frames.slice(0, t + 2)));
  const moment = Math.min(still.t, session.newest);
  view.draw(session.main.frames, moment, { rules, selected, theme: colours, area });
  if (meddled) twinView.draw(session.twin.frames, moment, { rules: { fates: {}, cuts: new Set() }, selected, theme: colours, area });
  panels(t, rules);
}

let drawn = "";
// What changes with steps and not with frames.
function panels(t, rules) {
  const frame = session.main.frames[t], agent = chosenAgent(), count = frame.scene.agents.length;
  const state = JSON.stringify([t, agent, count, still.playing, session.start.seed, session.events, session.revision, byId("curves").clientWidth]);
  if (state === drawn) return;
  drawn = state;
  say(byId("play"), still.playing ? "Pause" : "Play");
  byId("scrub").max = String(session.length);
  byId("scrub").value = String(t);
  say(byId("step"), `step ${t} of ${session.length}`);
  say(byId("count"), `${count} ${page.words.agent}${count === 1 ? "" : "s"}`);
  byId("more").disabled = count >= session.world.most;
  byId("fewer").disabled = count <= session.world.least;
  say(byId("verdict"), verdict(page, session, t));
  const silent = Object.values(rules.fates).filter((fate) => fate.kind === "silence").length >= count;
  say(byId("hush"), silent ? "Let them speak" : "Silence them all");
  view.canvas.setAttribute("aria-label", `${count} agents, ${frame.scene.marks.length} ${page.words.mark}s, step ${t}`);
  reach(rules, count);
  voices.draw(t, still.selected);
  inspector.draw(frame, agent, rules);
  drawGauges(page, session, t);
  drawCurves(byId("curves"), page, session, t, colours);
}

function reach(rules, count) {
  if (rules.radius !== null && document.activeElement !== byId("radius")) byId("radius").value = String(rules.radius);
  if (rules.radius !== null) say(byId("radius-value"), rules.radius.toFixed(1));
  for (const [place, id] of ["cut-a", "cut-b"].entries()) {
    const list = byId(id);
    if (list.length === count) continue;
    list.replaceChildren(...Array.from({ length: count }, (_, i) => make("option", { value: i, selected: i === Math.min(place, count - 1) }, `agent ${i}`)));
  }
}

function introduce() {
  say(byId("title"), page.title);
  say(byId("summary"), `${page.summary.charAt(0).toUpperCase()}${page.summary.slice(1)}.`);
  const talks = page.replays ? page.replays.silenced.length > 0 : page.network.settings.communication !== "none";
  say(byId("invitation"), invitation(talks));
  byId("talk").hidden = byId("hush").hidden = !talks;
  byId("team").hidden = session.world.most === session.world.least;
  byId("reach").hidden = !(talks && session.reaches);
  byId("cutting").hidden = !talks || Boolean(page.replays);
  byId("drag").hidden = !session.movable;
  byId("hands").hidden = ["team", "reach", "cutting", "drag"].every((id) => byId(id).hidden);
  say(byId("drag"), `Drag agents and ${page.words.mark}s in the picture, also while they run.`);
}

function invitation(talks) {
  if (!talks) return "";
  if (page.world?.knows) {
    return "Each agent has to reach the landmark at the end of its dotted line, and only another agent knows which one that is. The letters are what they tell each other. "
      + "Silence an agent and watch.";
  }
  if (page.replays) return "The letters are what they say. Silence everyone and watch what they do without their words.";
  if (session.world.most > session.world.least) return "The letters are what they say. Drag a landmark, add agents, or silence everyone: do they need their words?";
  return "The letters are what they say. Silence an agent and watch what the others do without its words.";
}

introduce();
const voices = new Voices(page, session, act), inspector = new Inspector(page, act);
connect(act, view);
if (asked !== null) still.t = Math.min(asked.at, session.length);
settle();
still.playing = asked === null && !calm;
globalThis.gacrlPage = { session, still, act, view };  // for the curious, and for tests

let before = null;
function frame(time) {
  advance(Math.min(time - (before ?? time), 250));
  before = time;
  draw();
  requestAnimationFrame(frame);
}
requestAnimationFrame(frame);
