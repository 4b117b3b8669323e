// The panel in which each agent's words are silenced, swapped, scrambled, delayed, dropped, or spoken by the visitor.

import { byId, make } from "./elements.js";
import { letter } from "./palette.js";
import { FATES } from "./words.js";

const LISTED = 8;  // of a larger team, the chosen agent alone has a row

export class Voices {
  // act: {fate(agents, fate)}: what the panel asks for.
  constructor(page, session, act) {
    this.page = page;
    this.session = session;
    this.act = act;
    this.list = byId("voices");
    this.shown = null;
  }

  // t: the step; selected: the chosen thing, or null.
  draw(t, selected) {
    const { session } = this, rules = session.standing(t), count = session.main.frames[t].scene.agents.length;
    const chosen = selected?.thing === "agent" && selected.index < count ? selected.index : 0;
    const listed = count <= LISTED ? Array.from({ length: count }, (_, i) => i) : [chosen];
    const state = JSON.stringify([listed, count, rules.fates]);
    if (state === this.shown) return;
    this.shown = state;
    const focused = document.activeElement?.dataset?.key;
    const everyone = Array.from({ length: count }, (_, i) => i);
    const rows = [this.row("Everyone", everyone, rules), ...(this.page.replays ? [] : listed.map((agent) => this.row(`Agent ${agent}`, [agent], rules)))];
    this.list.replaceChildren(...rows);
    if (focused) this.list.querySelector(`[data-key="${focused}"]`)?.focus();
  }

  row(name, agents, rules) {
    const kinds = new Set(agents.map((agent) => rules.fates[agent]?.kind ?? "free")), kind = kinds.size === 1 ? [...kinds][0] : "";
    const key = agents.length === 1 ? agents[0] : "all", silent = kind === "silence";
    const parts = [
      make("span", { class: "who" }, name),
      make("button", {
        type: "button", "aria-pressed": silent, "data-key": `silence-${key}`, class: silent ? "silent" : null,
        "aria-label": `Silence ${name.toLowerCase()}`, onclick: () => this.act.fate(agents, silent ? null : { kind: "silence" }),
      }, silent ? "Silenced" : "Silence"),
    ];
    if (!this.page.replays) parts.push(this.choice(name, agents, kind, key));
    if (kind === "speak" && agents.length === 1) parts.push(...this.mouth(agents[0], rules.fates[agents[0]].value));
    return make("li", {}, ...parts);
  }

  // What else may happen to the words.
  choice(name, agents, kind, key) {
    const rounds = this.page.network.settings.rounds, count = this.session.main.frames[0].scene.agents.length;
    const offered = Object.entries({
      free: "as spoken", swap: "swapped", scramble: "from another episode", delay: "3 steps late", drop: "half of them lost", speak: "I speak myself",
    }).filter(([it]) => (it !== "speak" || (agents.length === 1 && this.page.network.settings.vocabulary > 0)) && (it !== "swap" || count > 1));
    const options = offered.map(([it, label]) => make("option", { value: it, selected: it === kind }, label));
    if (kind === "silence") options.unshift(make("option", { value: "silence", selected: true }, "not at all"));
    if (kind === "") options.unshift(make("option", { value: "", selected: true }, "various"));
    return make("label", { class: "arrive" }, make("span", {}, "arrive"), make("select", {
      "data-key": `fate-${key}`, "aria-label": `How the words of ${name.toLowerCase()} arrive`,
      onchange: (event) => {
        const chosen = event.target.value;
        if (chosen === "free" || chosen === "") this.act.fate(agents, null);
        else if (chosen === "swap") this.act.swap(agents);
        else if (chosen === "speak") this.act.fate(agents, { kind: "speak", value: Array(rounds).fill(0) });
        else if (Object.hasOwn(FATES, chosen)) this.act.fate(agents, { kind: chosen });
      },
    }, ...options));
  }

  // Which words the visitor says: one for each round.
  mouth(agent, value) {
    const { vocabulary } = this.page.network.settings, said = [...value];  // of all rounds: a quick hand chooses two before they are drawn
    return value.map((symbol, round) => make("select", {
      "data-key": `say-${agent}-${round}`, "aria-label": `Your word of round ${round + 1} for agent ${agent}`, class: "mouth",
      onchange: (event) => {
        said[round] = Number(event.target.value);
        this.act.fate([agent], { kind: "speak", value: [...said] });
      },
    }, ...Array.from({ length: vocabulary }, (_, k) => make("option", { value: k, selected: k === symbol }, letter(k)))));
  }
}
