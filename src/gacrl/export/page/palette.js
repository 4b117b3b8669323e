// Colours and their names. Nothing is said by colour alone: words have letters, landmarks have shapes.

export const COLOUR_NAMES = ["blue", "amber", "purple", "sky", "rust", "yellow", "graphite", "pink"];
export const SHAPES = ["circle", "triangle", "square", "diamond", "star", "cross", "hexagon", "drop"];

export const INK = "#1f2933";

// A, B, … Z, A1, …
export function letter(symbol) {
  return String.fromCharCode(65 + (symbol % 26)) + (symbol >= 26 ? Math.floor(symbol / 26) : "");
}

export function colourName(index) {
  return `${COLOUR_NAMES[index % COLOUR_NAMES.length]} ${SHAPES[index % SHAPES.length]}`;
}

// Ink or paper, whichever stands out more on a colour.
export function readableOn(colour) {
  const [red, green, blue] = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  return 0.299 * red + 0.587 * green + 0.114 * blue > 140 ? INK : "#ffffff";
}

// The colours of the page's theme, as the style sheet has them.
export function theme() {
  const style = getComputedStyle(document.documentElement);
  const names = ["ink", "faint", "paper", "ground", "outside", "border", "body", "rim", "trail", "alarm", "edge"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}
