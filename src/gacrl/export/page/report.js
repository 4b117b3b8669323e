// Episodes of a report, as they were recorded: which group, which of its episodes, and the moment in it.

import { byId, make, say } from "./elements.js";
import { aboutAgent } from "./explain.js";
import { NORMAL, REACH, speedOptions } from "./habits.js";
import { theme } from "./palette.js";
import { framesOf } from "./recording.js";
import { areaOf, SceneView } from "./scene.js";

const page = JSON.parse(byId("live-data").textContent);
const still = { group: 0, episode: 0, t: 0, playing: false, speed: NORMAL, loop: 0, agent: 0, frames: [], area: null };

const canvas = make("canvas", { id: "live-canvas", tabindex: 0, role: "img", "aria-describedby": "live-keys" });
const groups = make("select", { onchange: () => act.open(Number(groups.value), 0) }, ...page.groups.map((group, k) => make("option", { value: k }, group.name)));
const episodes = make("select", { onchange: () => act.open(still.group, Number(episodes.value)) });
const play = make("button", { type: "button", class: "main", onclick: () => act.toggle() }, "Play");
const scrub = make("input", { type: "range", min: 0, value: 0, step: 1, "aria-label": "Step", oninput: () => act.seek(Number(scrub.value)) });
const step = make("output"), told = make("p", { class: "told", role: "status" }), name = make("h3"), about = make("dl");
const speed = make("select", { onchange: () => { still.speed = Number(speed.value); } }, ...speedOptions());
const view = new SceneView(canvas, page.colours);

const act = {
  // An episode from its start.
  open(group, episode) {
    Object.assign(still, { group, episode, t: 0, playing: false });
    const shown = page.groups[group].episodes;
    if (episodes.dataset.group !== String(group)) episodes.replaceChildren(...shown.map((it, k) => make("option", { value: k }, title(it))));
    episodes.dataset.group = String(group);
    [groups.value, episodes.value] = [String(group), String(episode)];
    still.frames = framesOf(shown[episode].replay);
    still.area = areaOf(still.frames);
    still.agent = Math.min(still.agent, still.frames[0].scene.agents.length - 1);
    draw();
  },
  next() {
    act.open(still.group, (still.episode + 1) % page.groups[still.group].episodes.length);
  },
  toggle() {
    if (!still.playing && still.t >= last()) still.t = 0;
    still.playing = !still.playing;
    draw();
    still.loop += 1;
    if (still.playing) pass(performance.now(), still.loop);
  },
  seek(t) {
    still.playing = false;
    still.t = Math.max(0, Math.min(t, last()));
    draw();
  },
  look(agent) {
    still.agent = agent;
    draw();
  },
};

function last() {
  return still.frames.length - 1;
}

function title({ rank, value, seed, number }) {
  return `${rank}: ${page.measure} ${value.toFixed(2)}, seed ${seed}, episode ${number}`.replace("-", "\u2212");
}

// Time passes while an episode plays: frame after frame until its end, or until somebody starts it anew.
function pass(before, loop) {
  requestAnimationFrame((time) => {
    if (!still.playing || loop !== still.loop) return;
    still.t = Math.min(still.t + (Math.max(0, Math.min(time - before, 250)) / 1000) * still.speed, last());
    if (still.t >= last()) still.playing = false;
    draw();
    pass(time, loop);
  });
}

function draw() {
  const t = Math.floor(still.t), frame = still.frames[t], count = frame.scene.agents.length;
  const selected = { thing: "agent", index: still.agent }, rules = { fates: {}, cuts: new Set() };
  view.draw(still.frames, still.t, { rules, selected, theme: theme(), area: still.area });
  say(play, still.playing ? "Pause" : "Play");
  scrub.max = String(last());
  scrub.value = String(t);
  say(step, `step ${t} of ${last()}`);
  const { marks } = frame.scene, lit = marks.filter((mark) => mark.there && mark.lit).length, there = marks.filter((mark) => mark.there).length;
  const goals = there > 0 ? `; ${lit} of ${there} ${page.words.mark}s ${page.words.lit}` : "";
  say(told, `${title(page.groups[still.group].episodes[still.episode])}. Return so far ${frame.totals.return.toFixed(2)}${goals}.`.replaceAll("-", "\u2212"));
  canvas.setAttribute("aria-label", `${count} ${page.words.agent}${count === 1 ? "" : "s"}, ${there} ${page.words.mark}s, step ${t}`);
  say(name, `Agent ${still.agent}`);
  about.replaceChildren(...aboutAgent(frame, still.agent, page, rules).flatMap(([what, it]) => [make("dt", {}, what), make("dd", {}, it)]));
}

function key(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
  if (event.key === " " && ["BUTTON", "SUMMARY"].includes(event.target.tagName)) return;
  const count = still.frames[0].scene.agents.length;
  const does = {
    " ": act.toggle, ",": () => act.seek(Math.floor(still.t) - 1), ".": () => act.seek(Math.floor(still.t) + 1), r: () => act.seek(0), n: act.next,
    a: () => act.look((still.agent + 1) % count),
  }[event.key];
  if (does === undefined) return;
  event.preventDefault();
  does();
}

// The agent under the pointer.
function caught(event) {
  const [x, y] = view.worldAt(event), far = (it) => Math.hypot(it.x - x, it.y - y) / Math.max(it.radius, 1e-6);
  const near = still.frames[Math.floor(still.t)].scene.agents.map((agent, index) => ({ index, there: agent.there, far: far(agent) }));
  const [best] = near.filter((it) => it.there && it.far < REACH).sort((a, b) => a.far - b.far);
  if (best !== undefined) act.look(best.index);
}

canvas.addEventListener("pointerdown", caught);
byId("live").append(
  make("div", { class: "row" }, make("label", {}, "Runs ", groups), make("label", {}, "Episode ", episodes)),
  told,
  make("div", { class: "stage" }, canvas, make("div", {}, name, about)),
  make("div", { class: "transport", role: "group", "aria-label": "Playback" },
    play,
    make("button", { type: "button", "aria-label": "One step back", onclick: () => act.seek(Math.floor(still.t) - 1) }, "‹"),
    make("button", { type: "button", "aria-label": "One step forward", onclick: () => act.seek(Math.floor(still.t) + 1) }, "›"),
    scrub, step, make("label", {}, "Speed ", speed)),
  make("p", { class: "keys", id: "live-keys" }, "Keys: space plays and pauses, comma and full stop step, r goes back to the start, n takes the next episode, a looks at the next agent."),
);
byId("live").addEventListener("keydown", key);  // elsewhere space turns the page
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
addEventListener("resize", draw);
globalThis.gacrlReport = { still, act, view };  // for the curious, and for tests
act.open(0, 0);
