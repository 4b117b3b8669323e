// The panel about one agent: what it sees, hears, says and does, the chances of its words, and what those words go with.

import { byId, make, say } from "./elements.js";
import { aboutAgent, aboutWord, actionName, percent } from "./explain.js";
import { letter } from "./palette.js";

const LIKELY = 4;

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
    this.offer(frame.scene.agents.length, index);
    const lines = aboutAgent(frame, index, this.page, rules);
    const said = frame.scene.agents[index].there === false ? [] : frame.decision?.said ?? [];
    const words = said.map((round, r) => aboutWord(this.page.dictionary, index, r, round[index], this.page)).filter(Boolean);
    const text = JSON.stringify([index, lines, words]);
    if (text === this.shown) return;
    this.shown = text;
    say(byId("about-name"), `Agent ${index}`);
    byId("about-list").replaceChildren(...[...lines, ...words.map((it) => ["Means", it])].flatMap(([name, it]) => [make("dt", {}, name), make("dd", {}, it)]));
    byId("chances").replaceChildren(...(frame.decision?.wordShares ? this.chances(frame.decision, index) : []));
  }

  offer(count, index) {
    if (this.chosen.length !== count) {
      this.chosen.replaceChildren(...Array.from({ length: count }, (_, i) => make("option", { value: i }, `agent ${i}`)));
    }
    if (this.chosen.value !== String(index)) this.chosen.value = String(index);
  }

  // Bars: how likely each word was, and how good each action looks to it.
  chances(decision, index) {
    const parts = decision.wordShares.flatMap((round, r) => [
      make("h3", {}, `Word of round ${r + 1}`),
      ...ranked(round[index]).map(([symbol, share]) => bar(letter(symbol), share, percent(share))),
    ]);
    const values = [...decision.values[index]], least = Math.min(...values), most = Math.max(...values);
    const worth = values.map((value, action) => bar(actionName(this.page, action), (value - least) / (most - least || 1), value.toFixed(2)));
    return [...parts, make("h3", {}, "What each action looks worth"), ...worth];
  }

  // All words that were recorded, the commonest first.
  listWords() {
    const entries = [...this.page.dictionary].sort((a, b) => a.agent - b.agent || a.round - b.round || b.share - a.share);
    byId("dictionary").hidden = entries.length === 0;
    const told = entries.filter((entry) => entry.share >= 0.005).map((entry) => aboutWord(this.page.dictionary, entry.agent, entry.round, entry.symbol, this.page));
    byId("entries").replaceChildren(...told.map((text) => make("li", {}, text)));
  }
}

function ranked(shares) {
  return shares.map((share, symbol) => [symbol, share]).sort((a, b) => b[1] - a[1]).slice(0, LIKELY).filter(([, share]) => share >= 0.005);
}

function bar(name, value, text) {
  return make("div", { class: "chance" }, make("span", {}, name), make("meter", { min: 0, max: 1, value, "aria-label": `${name}: ${text}` }), make("span", {}, text));
}
