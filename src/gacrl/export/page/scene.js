// Draws a moment of an episode on a canvas: what a task's scene shows, who hears whom, and what is said.

import { INK, letter, readableOn } from "./palette.js";

const TRAIL = 8;
const MARGIN = 0.06;
const JUMP = 4;  // a step of so many radii is a new placement
const CROWD = 14;  // more agents than these have no number, badge or wandering dots

export class SceneView {
  // colours: {symbols, lit, unlit}.
  constructor(canvas, colours) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.colours = colours;
    this.size = 0;
    this.words = [];
    this.drawn = this.bitmap = null;
  }

  // Fit the canvas to its place on the page, sharp on every screen.
  fit() {
    const side = Math.round(this.canvas.clientWidth * Math.min(window.devicePixelRatio || 1, 2));
    if (this.canvas.width !== side || this.canvas.height !== side) this.canvas.width = this.canvas.height = side;
    this.size = side;
    this.unit = Math.max(side / 480, (0.7 * side) / this.canvas.clientWidth);  // letters stay readable on a phone
  }

  // frames: of the episode so far, and one more; t: the moment, between two of them.
  // extra: {rules, selected, theme, area}; area: what of the world is shown (`areaOf`).
  draw(frames, t, extra) {
    this.fit();
    const now = Math.min(Math.floor(t), frames.length - 1), frame = frames[now], next = frames[now + 1] ?? frame;
    const fraction = t - now;
    this.words = [];
    this.theme = extra.theme;
    this.view = extra.area;
    const agents = frame.scene.agents.map((agent, i) => this.between(agent, next.scene.agents[i], fraction));
    const marks = frame.scene.marks.map((mark, i) => this.between(mark, next.scene.marks[i], fraction));
    const crowded = agents.length > CROWD;
    this.ground(frame.scene);
    agents.forEach((agent, i) => agent.there && this.trail(frames, now, i, agent));
    if (!crowded) agents.forEach((agent) => this.leash(agent, marks[agent.goal]));
    if (frame.decision) this.edges(frame.decision, agents, fraction, extra, crowded);
    if (frame.decision && extra.selected?.thing === "agent") this.gaze(frame.decision, agents, marks, extra.selected.index);
    marks.forEach((mark, i) => mark.there && this.mark(mark, isSelected(extra.selected, "mark", i)));
    agents.forEach((agent, i) => agent.there && this.agent(agent, i, isSelected(extra.selected, "agent", i), crowded));
    marks.forEach((mark) => mark.there && mark.lit && this.ring(mark));
    if (frame.decision) agents.forEach((agent, i) => agent.there && this.bubble(frame.decision, agent, i, extra.rules.fates[i], crowded));
  }

  // A thing on its way from one step to the next, in pixels.
  between(now, next, fraction) {
    const jumped = next === undefined || Math.hypot(next.x - now.x, next.y - now.y) > JUMP * Math.max(now.radius, 0.1);
    const part = jumped ? 0 : fraction;
    const [x, y] = this.place(now.x + ((next ?? now).x - now.x) * part, now.y + ((next ?? now).y - now.y) * part);
    return { there: true, ...now, x, y, radius: now.radius * this.scale() };
  }

  scale() {
    return (this.size * (0.5 - MARGIN)) / this.view.reach;
  }

  place(x, y) {
    return [this.size / 2 + (x - this.view.x) * this.scale(), this.size / 2 - (y - this.view.y) * this.scale()];
  }

  // Where in the world a point of the page is: `place` the other way round.
  worldAt(event) {
    const box = this.canvas.getBoundingClientRect(), ratio = this.size / box.width;
    return [
      this.view.x + ((event.clientX - box.left) * ratio - this.size / 2) / this.scale(),
      this.view.y - ((event.clientY - box.top) * ratio - this.size / 2) / this.scale(),
    ];
  }

  // The word whose bubble is under a point of the page; null where there is none.
  wordAt(event) {
    const box = this.canvas.getBoundingClientRect(), ratio = this.size / box.width;
    const [x, y] = [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
    return this.words.findLast((word) => Math.hypot(word.x - x, word.y - y) < word.size) ?? null;
  }

  ground(scene) {
    const { pen, theme } = this;
    pen.fillStyle = theme.outside;
    pen.fillRect(0, 0, this.size, this.size);
    if (scene.ground) {
      const [left, top] = this.place(scene.ground[0], scene.ground[3]), [right, bottom] = this.place(scene.ground[2], scene.ground[1]);
      pen.fillStyle = theme.ground;
      pen.fillRect(left, top, right - left, bottom - top);
      if (scene.drawn) this.backdrop(scene.drawn, left, top, right - left, bottom - top);
    }
    for (const [x0, y0, x1, y1] of scene.lines ?? []) this.line(this.place(x0, y0), this.place(x1, y1), theme.border, 2);
  }

  // What the task itself draws, as large as it goes: the last picture until this one is decoded.
  backdrop(drawn, left, top, width, height) {
    if (this.drawn !== drawn) {
      this.drawn = drawn;
      const bytes = Uint8Array.from(atob(drawn), (sign) => sign.charCodeAt(0));
      createImageBitmap(new Blob([bytes], { type: "image/png" })).then((bitmap) => { if (this.drawn === drawn) this.bitmap = bitmap; });
    }
    if (!this.bitmap) return;
    const scale = Math.min(width / this.bitmap.width, height / this.bitmap.height);
    const [wide, high] = [this.bitmap.width * scale, this.bitmap.height * scale];
    this.pen.drawImage(this.bitmap, left + (width - wide) / 2, top + (height - high) / 2, wide, high);
  }

  line([x0, y0], [x1, y1], colour, width, dash = [], alpha = 1) {
    const { pen } = this;
    pen.globalAlpha = alpha;
    pen.strokeStyle = colour;
    pen.lineWidth = width * this.unit;
    pen.setLineDash(dash.map((length) => length * this.unit));
    pen.beginPath();
    pen.moveTo(x0, y0);
    pen.lineTo(x1, y1);
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  // Where an agent came from: the older, the fainter.
  trail(frames, now, i, agent) {
    let end = [agent.x, agent.y];
    for (let age = 0; age < TRAIL && now - age >= 0; age++) {
      const past = frames[now - age].scene.agents[i];
      if (past === undefined || past.there === false) return;
      const start = this.place(past.x, past.y);
      if (Math.hypot(end[0] - start[0], end[1] - start[1]) > JUMP * Math.max(agent.radius, 8 * this.unit)) return;
      this.line(start, end, this.theme.trail, 3, [], 0.8 * (1 - age / TRAIL));
      end = start;
    }
  }

  // From an agent to where it has to go.
  leash(agent, mark) {
    if (mark === undefined || !agent.there) return;
    this.line([agent.x, agent.y], [mark.x, mark.y], this.symbol(mark.colour), 1.5, [2, 5], 0.8);
  }

  // Who hears whom: as thick as the listener's attention, with the word on its way.
  edges(decision, agents, fraction, extra, crowded) {
    decision.hears.forEach((speakers, listener) => {
      speakers.forEach((speaker, k) => {
        const from = agents[speaker], to = agents[listener];
        if (!from?.there || !to?.there) return;
        const shares = decision.heeded.map((round) => round[listener][k]);
        const attention = shares.length === 0 ? 0.3 : shares.reduce((sum, share) => sum + share, 0) / shares.length;
        const chosen = extra.selected?.thing === "agent" && extra.selected.index === listener;
        if (crowded && attention < 0.08 && !chosen) return;
        // Both directions lie side by side.
        const ends = apart(from, to, 2.5 * this.unit);
        this.line(...ends, this.theme.edge, 0.8 + 3.2 * attention, [], chosen ? 0.95 : crowded ? 0.25 : 0.5);
        if (!crowded && decision.said.length > 0) this.wandering(decision, speaker, ends, fraction, attention);
      });
    });
    for (const edge of extra.rules.cuts) {
      const [a, b] = edge.split("-").map((index) => agents[Number(index)]);
      if (a?.there && b?.there) this.line([a.x, a.y], [b.x, b.y], this.theme.alarm, 1.5, [3, 6], 0.7);
    }
  }

  // A dot in the word's colour that goes from who speaks to who hears.
  wandering(decision, speaker, [[x0, y0], [x1, y1]], fraction, attention) {
    const round = Math.min(Math.floor(fraction * decision.said.length), decision.said.length - 1);
    const part = fraction * decision.said.length - round, { pen } = this;
    pen.fillStyle = this.symbol(decision.arrived[round][speaker]);
    pen.strokeStyle = this.theme.paper;
    pen.lineWidth = this.unit;
    pen.beginPath();
    pen.arc(x0 + (x1 - x0) * part, y0 + (y1 - y0) * part, (2.5 + 2.5 * attention) * this.unit, 0, 2 * Math.PI);
    pen.fill();
    pen.stroke();
  }

  // At which landmarks the chosen agent looks once more after it has heard.
  gaze(decision, agents, marks, index) {
    for (const { index: landmark, share } of decision.looks[index] ?? []) {
      if (share > 0.02) this.line([agents[index].x, agents[index].y], [marks[landmark].x, marks[landmark].y], this.theme.ink, 1 + 4 * share, [1, 3], 0.7);
    }
  }

  symbol(index) {
    return this.colours.symbols[index % this.colours.symbols.length];
  }

  mark(mark, selected) {
    const { pen } = this, own = mark.colour >= 0, ink = own ? this.symbol(mark.colour) : this.theme.faint;
    const radius = Math.max(mark.radius, 5 * this.unit);
    this.circle(mark.x, mark.y, radius, mark.lit ? this.colours.lit : null, 0.35);
    pen.setLineDash(mark.lit ? [] : [4 * this.unit, 3 * this.unit]);
    this.outline(mark, radius, ink, own ? 2.5 : 1.5);
    pen.setLineDash([]);
    if (own) this.shape(mark.x, mark.y, radius * 0.5, mark.colour);
    else if (!mark.lit) this.line([mark.x - radius * 0.3, mark.y], [mark.x + radius * 0.3, mark.y], ink, 1.5);
    if (!own && !mark.lit) this.line([mark.x, mark.y - radius * 0.3], [mark.x, mark.y + radius * 0.3], ink, 1.5);
    if (selected) this.halo(mark, radius);
  }

  agent(agent, index, selected, crowded) {
    const radius = Math.max(agent.radius, 6 * this.unit), own = agent.colour >= 0;
    this.circle(agent.x, agent.y, radius, this.theme.body, 0.85);
    const alarm = agent.touching || agent.alarm, rim = own ? this.symbol(agent.colour) : this.theme.rim;
    this.outline(agent, radius, alarm ? this.theme.alarm : rim, own || alarm ? 3 : 1.5);
    if (own) this.shape(agent.x, agent.y + radius * 0.5, radius * 0.26, agent.colour);
    if (!crowded || radius > 9 * this.unit) this.text(String(index), agent.x, agent.y - (own ? radius * 0.18 : 0), radius * (index > 9 ? 0.8 : 1), this.theme.ink);
    if (selected) this.halo(agent, radius);
  }

  halo(thing, radius) {
    this.outline(thing, radius + 4 * this.unit, this.theme.ink, 2);
  }

  // What shows a lit mark through the agent that stands on it.
  ring(mark) {
    this.outline(mark, Math.max(mark.radius, 5 * this.unit), this.colours.lit, 2.5);
  }

  outline({ x, y }, radius, colour, width) {
    const { pen } = this;
    pen.strokeStyle = colour;
    pen.lineWidth = width * this.unit;
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.stroke();
  }

  // The shape that goes with a colour, for those who cannot tell colours apart.
  shape(x, y, size, colour) {
    const { pen } = this, corners = [0, 3, 4, 4, 10, 12, 6, 5][colour % 8], turn = [0, 0, Math.PI / 4, 0, 0, 0, 0, 0][colour % 8];
    pen.fillStyle = this.symbol(colour);
    pen.strokeStyle = this.theme.paper;
    pen.lineWidth = this.unit;
    pen.beginPath();
    if (corners === 0) pen.arc(x, y, size, 0, 2 * Math.PI);
    for (let k = 0; k < corners; k++) {
      const angle = turn - Math.PI / 2 + (2 * Math.PI * k) / corners, far = corners >= 10 && k % 2 ? size * 0.45 : size * 1.15;
      pen.lineTo(x + far * Math.cos(angle), y + far * Math.sin(angle));
    }
    pen.closePath();
    pen.fill();
    pen.stroke();
  }

  // What is heard of an agent: a letter for each round. A line through it: nobody does; under it: it said something else.
  bubble(decision, agent, index, fate, crowded) {
    const spoken = decision.arrived.map((words, round) => ({ round, symbol: words[index] })).filter(({ symbol }) => symbol >= 0);
    if (spoken.length === 0) return;
    const size = (crowded ? 5.5 : 11) * this.unit, away = (Math.max(agent.radius, 6 * this.unit) + size * 0.6) * Math.SQRT1_2;
    const x = agent.x + away, y = agent.y - away;
    spoken.forEach(({ round, symbol }, k) => {
      const colour = this.symbol(symbol), at = x + 1.8 * size * k;
      this.words.push({ thing: "agent", index, round, symbol, x: at, y, size });
      this.circle(at, y, size + 1.5 * this.unit, this.theme.paper);
      this.circle(at, y, size, colour, fate?.kind === "silence" ? 0.35 : 1);
      this.text(letter(symbol), at, y, size * (symbol >= 26 ? 1 : 1.35), fate?.kind === "silence" ? INK : readableOn(colour));
    });
    const end = x + 1.8 * size * (spoken.length - 1);
    if (fate?.kind === "silence") this.line([x - size, y + size * 0.9], [end + size, y - size * 0.9], this.theme.alarm, 3);
    else if (fate) this.line([x - size, y + size * 1.35], [end + size, y + size * 1.35], this.theme.alarm, 3, fate.kind === "speak" ? [] : [4, 3]);
  }

  circle(x, y, radius, colour, alpha = 1) {
    if (colour === null) return;
    const { pen } = this;
    pen.globalAlpha = alpha;
    pen.fillStyle = colour;
    pen.beginPath();
    pen.arc(x, y, radius, 0, 2 * Math.PI);
    pen.fill();
    pen.globalAlpha = 1;
  }

  text(text, x, y, size, colour) {
    const { pen } = this;
    pen.fillStyle = colour;
    pen.font = `600 ${size}px system-ui, sans-serif`;
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    pen.fillText(text, x, y + size * 0.06);
  }
}

// Centre and half the width of the square that holds all that happened in these frames: it never shrinks on the way.
export function areaOf(frames) {
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  const hold = (x, y, radius = 0) => {
    [left, right, low, high] = [Math.min(left, x - radius), Math.max(right, x + radius), Math.min(low, y - radius), Math.max(high, y + radius)];
  };
  for (const { scene } of frames) {
    for (const thing of [...scene.agents, ...scene.marks]) if (thing.there !== false) hold(thing.x, thing.y, thing.radius);
    if (scene.ground) hold(scene.ground[0], scene.ground[1]);
    if (scene.ground) hold(scene.ground[2], scene.ground[3]);
    for (const [x0, y0, x1, y1] of scene.lines ?? []) [hold(x0, y0), hold(x1, y1)];
  }
  return { x: (left + right) / 2, y: (low + high) / 2, reach: Math.max(right - left, high - low, 1e-6) / 2 };
}

function isSelected(selected, thing, index) {
  return selected?.thing === thing && selected.index === index;
}

// The ends of a line beside the one that goes the other way.
function apart(from, to, side) {
  const length = Math.hypot(to.x - from.x, to.y - from.y) || 1;
  const dx = (-(to.y - from.y) / length) * side, dy = ((to.x - from.x) / length) * side;
  return [[from.x + dx, from.y + dy], [to.x + dx, to.y + dy]];
}
