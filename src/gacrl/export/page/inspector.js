// The panel about one agent: what it sees, hears, says and does, the chances of its words, and what those words go with.

import { byId, make, say } from "./elements.js";
import { aboutAgent, aboutWord, actionName, actionShares, actionValues, percent } from "./explain.js";
import { letter } from "./palette.js";

const LIKELY = 4;  // words
const BEST = 8;  // actions

export class Inspector {
  constructor(page, act) {
    this.page = page;
    this.shown = null;
    this.chosen = byId("choose");
    this.chosen.addEventListener("change", () => act.select({ thing: "agent", index: Number(this.chosen.value) }));
    this.listWords();
  }

  // About an agent in a frame; rules: what holds there.
  draw(frame, index, rules) {
    if (this.listed !== this.page.dictionary) this.listWords();
    this.offer(frame.scene.agents.length, index);
    const lines = aboutAgent(frame, index, this.page, rules);
    const said = frame.scene.agents[index].there === false ? [] : frame.decision?.said ?? [];
    const words = said.map((round, r) => aboutWord(this.page.dictionary, index, r, round[index], this.page)).filter(Boolean);
    const text = JSON.stringify([index, lines, words]);
    if (text === this.shown) return;
    this.shown = text;
    say(byId("about-name"), `Agent ${index}`);
    byId("about-list").replaceChildren(...[...lines, ...words.map((it) => ["Means", it])].flatMap(([name, it]) => [make("dt", {}, name), make("dd", {}, it)]));
    byId("chances").replaceChildren(...(frame.decision ? this.chances(frame, index) : []));
  }

  offer(count, index) {
    if (this.chosen.length !== count) {
      this.chosen.replaceChildren(...Array.from({ length: count }, (_, i) => make("option", { value: i }, `agent ${i}`)));
    }
    if (this.chosen.value !== String(index)) this.chosen.value = String(index);
  }

  // Bars: how likely each word was, and how likely each action is or how good it looks to it.
  chances(frame, index) {
    const words = (frame.decision.wordShares ?? []).flatMap((round, r) => [
      make("h3", {}, `Word of round ${r + 1}`),
      ...ranked(round[index]).map(([symbol, share]) => bar(letter(symbol), share, percent(share))),
    ]);
    const actions = this.page.network?.settings.draws
      ? bars("Chances of each action", this.page, actionShares(frame, index), (share) => share, percent)
      : bars("What each action looks worth", this.page, ...scaled(actionValues(frame, index)), (value) => value.toFixed(2));
    return [...words, ...actions];
  }

  // All words that were recorded, the commonest first.
  listWords() {
    this.listed = this.page.dictionary;
    say(byId("heading"), `What the words go with${this.page.heard ? `, in ${this.page.heard.toLocaleString("en")} recorded episodes` : ""}`);
    const entries = [...this.page.dictionary].sort((a, b) => a.agent - b.agent || a.round - b.round || b.share - a.share);
    byId("dictionary").hidden = entries.length === 0;
    const told = entries.filter((entry) => entry.share >= 0.005).map((entry) => aboutWord(this.page.dictionary, entry.agent, entry.round, entry.symbol, this.page));
    byId("entries").replaceChildren(...told.map((text) => make("li", {}, text)));
  }
}

function ranked(shares) {
  return shares.map((share, symbol) => [symbol, share]).sort((a, b) => b[1] - a[1]).slice(0, LIKELY).filter(([, share]) => share >= 0.005);
}

// The numbers, and where each lies between the least and the most of them.
function scaled(values) {
  const least = Math.min(...values.values()), most = Math.max(...values.values());
  return [values, (value) => (value - least) / (most - least || 1)];
}

function bars(title, page, numbers, part, text) {
  if (numbers.size === 0) return [];
  const best = new Set([...numbers].sort((a, b) => b[1] - a[1]).slice(0, BEST).map(([action]) => action)), some = best.size < numbers.size;
  const listed = [...numbers].filter(([action]) => best.has(action));
  return [make("h3", {}, some ? `${title}: the best ${BEST} of ${numbers.size}` : title), ...listed.map(([action, value]) => bar(actionName(page, action), part(value), text(value)))];
}

function bar(name, value, text) {
  return make("div", { class: "chance" }, make("span", {}, name), make("meter", { min: 0, max: 1, value, "aria-label": `${name}: ${text}` }), make("span", {}, text));
}
