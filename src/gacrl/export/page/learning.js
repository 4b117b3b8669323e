// How learning goes, beside the policy that plays: the task's headline after each evaluation, a line for each seed.

import { byId, make, say } from "./elements.js";
import { theme } from "./palette.js";

let shown = null;

// news: {label, steps, seeds: [[value, …], …], done: share, playing: steps of the policy that plays}.
export function drawLearning(news) {
  if (byId("learning") === null) {
    const canvas = make("canvas", { id: "learning-curve", role: "img" });
    const section = make("section", { id: "learning" }, make("h2", {}, "How it learns"), make("p", { id: "learning-step" }), canvas);
    byId("curves").closest("section").after(section);
    new ResizeObserver(() => plot()).observe(canvas);
  }
  shown = news;
  plot();
}

function plot() {
  const { label, steps, seeds, playing } = shown, canvas = byId("learning-curve"), last = steps.at(-1);
  const best = seeds.map((values) => values.at(-1).toFixed(2)).join(", ");
  say(byId("learning-step"), `${label}: ${best} after ${last.toLocaleString("en")} steps. The policy that plays has ${playing.toLocaleString("en")}; a new start takes the newest.`);
  canvas.setAttribute("aria-label", `${label} over training steps, now ${best}`);
  const ratio = Math.min(window.devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight, colours = theme();
  [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
  const pen = canvas.getContext("2d"), values = seeds.flat(), least = Math.min(...values), most = Math.max(...values);
  const at = (k, value) => [8 + ((width - 16) * steps[k]) / last, 18 + ((height - 36) * (most - value)) / (most - least || 1)];
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.strokeStyle = colours.edge;
  pen.lineWidth = seeds.length > 1 ? 1.25 : 2.5;
  for (const row of seeds) {
    pen.beginPath();
    row.forEach((value, k) => pen.lineTo(...at(k, value)));
    pen.stroke();
    pen.fillStyle = colours.edge;
    pen.fillRect(...at(row.length - 1, row.at(-1)).map((place) => place - 2), 4, 4);
  }
  pen.fillStyle = colours.faint;
  pen.font = "12px system-ui, sans-serif";
  pen.fillText(most.toFixed(2), 8, 11);
  pen.fillText(least.toFixed(2), 8, height - 3);
}
