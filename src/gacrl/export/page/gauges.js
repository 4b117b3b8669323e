// Numbers of the moment: this run's, those of the untouched one, and those of policies that learn nothing.

import { byId, make } from "./elements.js";
import { percent } from "./explain.js";

const COLLISIONS = "collisions";

// The table for step t.
export function drawGauges(page, session, t) {
  const main = session.main.frames[t], twin = session.meddled ? session.twin.frames[t] : null;
  const names = Object.keys(page.yardsticks), rows = [["Return", (frame) => frame.totals.return, "return", (x) => x.toFixed(1)]];
  if (main.scene.marks.length > 0) rows.push([capital(page.words.lit), (frame) => frame.share, "share", percent]);
  if (page.measures[COLLISIONS]) rows.push(["Collisions", (frame) => frame.totals.collisions, COLLISIONS, (x) => String(Math.round(x))]);
  const comparable = session.start.count === page.world?.num_agents && main.scene.agents.length === session.start.count;
  const yardsticks = comparable ? names : [];
  const head = ["", ...rows.map(([label]) => label)];
  const lane = (name, frame) => [name, ...rows.map(([, of, , format]) => format(of(frame)))];
  const cells = [
    lane(session.names?.main ?? (twin ? "Here" : "Now"), main), ...(twin ? [lane(session.names?.twin ?? "Untouched", twin)] : []),
    ...yardsticks.map((name) => [name, ...rows.map(([, , measure, format]) => (
      t === 0 && measure !== "share" ? format(0) : known(page.yardsticks[name][measure], t, format)))]),
  ];
  const table = byId("gauges"), text = JSON.stringify([head, cells]);
  if (table.dataset.shown === text) return;
  table.dataset.shown = text;
  const line = (texts, tag) => make("tr", {}, ...texts.map((it, k) => make(k === 0 ? "th" : tag, { scope: tag === "th" ? "col" : k === 0 ? "row" : null }, it)));
  table.tHead.replaceChildren(line(head, "th"));
  table.tBodies[0].replaceChildren(...cells.map((row) => line(row, "td")));
}

function known(curve, t, format) {
  return curve === undefined ? "" : format(curve[Math.min(Math.max(t - 1, 0), curve.length - 1)]);
}

// Returns so far of both lanes and of the yardsticks, as curves with their names at the end.
export function drawCurves(canvas, page, session, t, theme) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio)) [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  const lane = (frames) => frames.slice(0, t + 1).map((frame) => frame.totals.return);
  const known = session.main.frames[t].scene.agents.length === page.world?.num_agents ? page.yardsticks : {};
  const curves = Object.entries(known).map(([name, it]) => ({ name, values: [0, ...it.return].slice(0, session.length + 1), colour: theme.faint, dash: [4, 3] }));
  if (session.meddled) curves.push({ name: session.names?.twin ?? "untouched", values: lane(session.twin.frames), colour: theme.edge, dash: [] });
  curves.push({ name: session.names?.main ?? (session.meddled ? "here" : "now"), values: lane(session.main.frames), colour: session.meddled ? theme.alarm : theme.edge, dash: [] });
  const least = Math.min(-1e-6, ...curves.flatMap((curve) => curve.values)), most = Math.max(0, ...curves.flatMap((curve) => curve.values));
  const at = (k, value) => [4 + ((width - 84) * k) / session.length, 8 + ((height - 16) * (most - value)) / (most - least)];
  const labels = [];
  for (const curve of curves) {
    pen.strokeStyle = curve.colour;
    pen.lineWidth = curve.dash.length ? 1.25 : 2.5;
    pen.setLineDash(curve.dash);
    pen.beginPath();
    curve.values.forEach((value, k) => pen.lineTo(...at(k, value)));
    pen.stroke();
    labels.push({ ...curve, y: at(0, curve.values.at(-1))[1], x: at(curve.values.length - 1, 0)[0] });
  }
  pen.setLineDash([]);
  placeLabels(pen, labels, height);
}

// Names beside the ends of curves, none over another.
function placeLabels(pen, labels, height) {
  pen.font = "12px system-ui, sans-serif";
  pen.textBaseline = "middle";
  labels.sort((a, b) => a.y - b.y);
  let above = -6, below = height + 6;
  for (const label of labels) above = label.y = Math.max(label.y, above + 13);
  for (const label of labels.toReversed()) below = label.y = Math.min(label.y, below - 13);
  for (const label of labels) {
    pen.fillStyle = label.colour;
    pen.fillText(label.name, label.x + 5, label.y);
  }
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}
