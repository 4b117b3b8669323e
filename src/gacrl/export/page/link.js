// A scene as the end of an address, and back: whoever opens the link sees the same. What makes no sense in it is left out.

import { FATES } from "./words.js";

const MOST_EVENTS = 400;
const FAR = 1000;

// The text behind the `#`.
export function written(start, events, t) {
  const parts = [`seed=${start.seed}`, `n=${start.count}`, `at=${t}`];
  const done = events.slice(-MOST_EVENTS).map((event) => [event.at, ...words(event)].join(":"));
  if (done.length > 0) parts.push(`do=${done.join(",")}`);
  return parts.join("&");
}

function words(event) {
  if (event.kind === "fate") return ["voice", event.agent, ...(event.fate === null ? ["free"] : [event.fate.kind, ...[event.fate.value ?? []].flat()])];
  if (event.kind === "radius") return ["radius", round(event.value)];
  if (event.kind === "cut") return ["cut", event.a, event.b, Number(event.on)];
  if (event.kind === "move") return ["move", event.thing, event.index, round(event.x), round(event.y)];
  return [event.kind];
}

function round(value) {
  return Number(value.toFixed(3));
}

// {seed, count, at, events}; null for an address that says nothing. world, policy: what the numbers must fit.
export function understood(text, world, policy) {
  const given = new Map(text.replace(/^#/, "").split("&").map((part) => part.split("=")));
  if (!given.has("seed")) return null;
  const events = (given.get("do") ?? "").split(",").slice(0, MOST_EVENTS)
    .map((part) => eventOf(part.split(":"), world, policy)).filter((event) => event !== null);
  return {
    seed: whole(given.get("seed"), 0, 2 ** 31) ?? 0,
    count: whole(given.get("n"), world.least, world.most) ?? world.least,
    at: whole(given.get("at"), 0, world.length) ?? 0,
    events: within(events, whole(given.get("n"), world.least, world.most) ?? world.least, world),
  };
}

function eventOf([when, kind, ...rest], world, policy) {
  const at = whole(when, 0, world.length);
  const event = at === null ? null : { voice, radius, cut, move, add: () => ({}), remove: () => ({}) }[kind]?.(rest, policy.settings, world);
  if (event === null || event === undefined) return null;
  return { at, kind: kind === "voice" ? "fate" : kind, ...event };
}

function voice([agent, kind, ...values], settings, world) {
  const who = whole(agent, 0, world.most - 1);
  if (who === null) return null;
  if (kind === "free") return { agent: who, fate: null };
  if (!Object.hasOwn(FATES, kind)) return null;
  if (kind !== "swap" && kind !== "speak") return { agent: who, fate: { kind } };
  const most = kind === "swap" ? world.most - 1 : settings.vocabulary - 1;
  const numbers = values.map((value) => whole(value, 0, most));
  if (numbers.includes(null) || numbers.length !== (kind === "swap" ? 1 : settings.rounds)) return null;
  return { agent: who, fate: { kind, value: kind === "swap" ? numbers[0] : numbers } };
}

function radius([value]) {
  const length = finite(value, 0, FAR);
  return length === null ? null : { value: length };
}

function cut([a, b, on], settings, world) {
  const ends = [a, b].map((agent) => whole(agent, 0, world.most - 1));
  return ends.includes(null) || ends[0] === ends[1] ? null : { a: ends[0], b: ends[1], on: on === "1" };
}

function move([thing, index, x, y], settings, world) {
  const which = whole(index, 0, world.most - 1), place = [x, y].map((value) => finite(value, -FAR, FAR));
  if (which === null || place.includes(null) || !["agent", "mark"].includes(thing)) return null;
  return { thing, index: which, x: place[0], y: place[1] };
}

// Without additions and removals that leave the world's bounds.
function within(events, count, world) {
  let agents = count;
  return events.sort((a, b) => a.at - b.at).filter((event) => {
    const after = agents + (event.kind === "add") - (event.kind === "remove");
    if (after < world.least || after > world.most) return false;
    agents = after;
    return true;
  });
}

function finite(text, least, most) {
  const value = text === undefined || text === "" ? NaN : Number(text);
  return Number.isFinite(value) && value >= least && value <= most ? value : null;
}

function whole(text, least, most) {
  const value = finite(text, least, most);
  return Number.isInteger(value) ? value : null;
}
