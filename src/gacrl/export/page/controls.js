// Buttons, keys and the pointer: each does one of the things in `act`.

import { byId } from "./elements.js";
import { REACH, speedOptions } from "./habits.js";

const NUDGE = 0.05;

// act: what can be done, as `main.js` has it; view: the picture that the pointer is on.
export function connect(act, view) {
  const buttons = {
    play: act.toggle, back: () => act.step(-1), forward: () => act.step(1), rewind: act.rewind, fresh: act.fresh,
    fewer: act.remove, more: act.add, cut: () => act.cut(Number(byId("cut-a").value), Number(byId("cut-b").value)), copy: act.copy, hush: act.hush,
  };
  for (const [id, does] of Object.entries(buttons)) byId(id).addEventListener("click", does);
  byId("speed").replaceChildren(...speedOptions());
  byId("scrub").addEventListener("input", (event) => act.seek(Number(event.target.value)));
  byId("speed").addEventListener("change", (event) => act.speed(Number(event.target.value)));
  byId("radius").addEventListener("input", (event) => act.radius(Number(event.target.value)));
  for (const id of ["cut-a", "cut-b"]) byId(id).addEventListener("change", act.chooseEdge);
  document.addEventListener("keydown", (event) => key(event, act, view.canvas));
  pointer(act, view);
}

function key(event, act, canvas) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const inField = ["SELECT", "INPUT"].includes(event.target.tagName), onButton = ["BUTTON", "SUMMARY"].includes(event.target.tagName);
  const onPicture = event.target === canvas;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
  if (onPicture && arrows) act.nudge(arrows[0] * NUDGE, arrows[1] * NUDGE);
  else if (inField) return;
  else if (event.key === " " && !onButton) act.toggle();
  else {
    const does = {
      ",": () => act.step(-1), ".": () => act.step(1), r: act.rewind, n: act.fresh, "[": () => act.faster(-1), "]": () => act.faster(1),
      "+": act.add, "-": act.remove, a: () => act.next("agent"), m: () => act.next("mark"), s: () => act.silence(false), S: () => act.silence(true),
    }[event.key];
    if (does === undefined) return;
    does();
  }
  event.preventDefault();
}

function pointer(act, view) {
  const { canvas } = view;
  canvas.addEventListener("pointerdown", (event) => {
    const thing = act.nearest(...view.worldAt(event), REACH);
    act.select(thing);
    if (thing === null) return;
    canvas.setPointerCapture(event.pointerId);
    act.grab(thing);
  });
  canvas.addEventListener("pointermove", (event) => act.drag(...view.worldAt(event), view.wordAt(event)));
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, act.drop);
  canvas.addEventListener("pointerleave", () => act.hover(null));
}
