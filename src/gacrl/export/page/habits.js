// What every page does alike: how fast it plays, how near a pointer must come, and with which episode it opens.

import { make } from "./elements.js";

export const SPEEDS = [2, 5, 10, 25];  // steps a second
export const NORMAL = 5;
export const REACH = 1.6;  // a thing is caught within so many of its radii
export const FIRST = 3;  // the seed that opens a page: a start in which agents with goals have different ones
const NAMES = ["slow", "normal", "fast", "very fast"];

export function speedOptions() {
  return SPEEDS.map((speed, k) => make("option", { value: speed, selected: speed === NORMAL }, NAMES[k]));
}
