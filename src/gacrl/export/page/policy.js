// The agents' network, as `gacrl.networks.agent`: an entity graph, a latent code, rounds of words, a second look, a head.
// Shared by all agents; greedy, so that nothing is drawn. `decide` follows the text of the Python modules it names.

import { addProduct, affine, concat, dot, indexOfLargest, layerOf, mixture, mlp, oneHot, raise, rectify, softmax } from "./numbers.js";

const NEAR = 0.2;  // arena units within which an offset is also given magnified
const SCALES = 5;

export class Policy {
  // settings: of `NetworkConfig`; tensors: {name: Float32Array}; rows: {name: outputs}.
  constructor(settings, tensors, rows) {
    const layer = (name) => layerOf(tensors[`${name}.weight`], tensors[`${name}.bias`] ?? null, rows[`${name}.weight`]);
    const layers = (name) => {
      const found = [];
      while (tensors[`${name}.layers.${found.length}.weight`]) found.push(layer(`${name}.layers.${found.length}`));
      return found;
    };
    this.settings = settings;
    this.rounds = settings.communication === "none" ? 0 : settings.rounds;
    this.torso = {
      rival: layer("torso.rival.layers.0"), landmark: layers("torso.landmark"), agent: layers("torso.agent"),
      attention: layer("torso.attention"), out: layers("torso.out"),
    };
    this.code = settings.latent === "none" ? null : { encode: layer("code.encode"), merge: layer("code.merge") };
    this.talk = Array.from({ length: this.rounds }, (_, r) => ({
      encode: layer(`communication.encode.${r}`), edge: layer(`communication.edge.${r}.layers.0`),
      query: layer(`communication.query.${r}`), merge: layer(`communication.merge.${r}`),
    }));
    this.look = settings.second_look ? { query: layer("look.query"), merge: layer("look.merge") } : null;
    this.head = layer("head");
  }

  // What all agents say and do. seen: what each of them sees (`world.observe`).
  // arriving(round, words): for each speaker the word that arrives of it; reaches(i, j): whether i still hears j.
  decide(seen, arriving, reaches) {
    const work = this.deciding(seen, arriving, reaches);
    for (;;) {
      const { done, value } = work.next();
      if (done) return value;
    }
  }

  // The same, agent by agent: a page with a hundred of them draws in between.
  *deciding(seen, arriving = (round, words) => words, reaches = () => true) {
    const looked = [];
    for (const one of seen) {
      looked.push(this.see(one));
      yield;
    }
    const meant = looked.map((it) => it.code ?? it.hidden);
    let hidden = looked.map((it) => it.hidden);
    const heard = seen.map((one, i) => this.nearestSpeakers(one, i, reaches));
    const said = [], arrived = [], wordShares = [], heeded = [];
    for (let round = 0; round < this.rounds; round++) {
      const logits = (round === 0 ? meant : hidden).map((vector) => affine(this.talk[round].encode, vector));
      said.push(logits.map((values) => indexOfLargest(values)));
      wordShares.push(logits.map(softmax));
      arrived.push(arriving(round, said[round]));
      const taken = seen.map((one, i) => this.listen(round, hidden[i], one, heard[i], arrived[round]));
      hidden = taken.map((it) => it.hidden);
      heeded.push(taken.map((it) => it.shares));
    }
    const final = looked.map((it, i) => this.lookAgain(hidden[i], it));
    const values = final.map((it) => affine(this.head, it.hidden));
    return {
      values,
      actions: values.map((row, i) => indexOfLargest(row, seen[i].available)),
      said, arrived, wordShares,  // words [R][N], and their chances [R][N][V]
      hears: heard,  // whom each agent hears, [N][K]
      heeded,  // how much of its attention each of them has, in each round [R][N][K]
      looks: final.map((it, i) => looked[i].landmarks.map((landmark, k) => ({ index: landmark.index, share: it.shares[k] }))),
    };
  }

  // `GraphTorso` and `Code`: from what one agent sees to its vector, and one for each landmark.
  see(one) {
    const { torso, settings } = this;
    const landmarks = nearest(one.landmarks, settings.nearest_landmarks);
    const agents = nearest(one.agents, settings.nearest_agents);
    const places = landmarks.map((landmark) => this.place(one.own, landmark, agents));
    const width = torso.attention.columns;
    const shares = softmax(places.map((place) => dot(torso.attention.weight, place)));
    const best = places.reduce(raise, new Float64Array(width));
    const others = agents.map((other) => mlp(torso.agent, concat(one.own, scales(other.x, other.y), other.features)));
    const crowd = others.reduce(raise, new Float64Array(torso.agent.at(-1).rows));
    const hidden = mlp(torso.out, concat(one.own, mixture(places, shares, width), best, crowd));
    if (this.code === null) return { hidden, code: null, places, landmarks };
    const code = affine(this.code.encode, hidden).slice(0, settings.latent_size);
    const merged = rectify(affine(this.code.merge, code));
    return { hidden: hidden.map((value, i) => value + merged[i]), code, places, landmarks };
  }

  // The vector of a landmark, for an agent that sees these others: who else stands how near to it.
  place(own, landmark, agents) {
    const { rival } = this.torso, { x, y } = landmark, pair = new Float64Array(rival.rows);
    const mine = affine(rival, concat(scales(-x, -y), landmark.features), undefined, SCALES);
    const contest = new Float64Array(rival.rows);
    for (const other of agents) {
      pair.set(mine);
      addProduct(rival, scales(other.x - x, other.y - y), pair);
      if (other.features.length > 0) addProduct(rival, other.features, pair, 2 * SCALES + landmark.features.length);
      raise(contest, rectify(pair));
    }
    return mlp(this.torso.landmark, concat(own, scales(x, y), landmark.features, contest), this.settings.seen_slope);
  }

  // Whom an agent hears: its nearest ones, where the network listens to so many.
  nearestSpeakers(one, i, reaches) {
    const speakers = one.speakers.filter((j) => reaches(i, j)), most = this.settings.nearest_agents;
    if (most === null || speakers.length <= most) return speakers;
    const distance = new Map(speakers.map((j) => [j, Math.hypot(...one.sight(j).slice(0, 2))]));
    return speakers.sort((a, b) => distance.get(a) - distance.get(b)).slice(0, most);
  }

  // `Symbols.speak`: what one agent makes of the words of a round.
  listen(round, hidden, one, speakers, words) {
    const { edge, query, merge } = this.talk[round], { vocabulary, heard_slope, speaker_identity } = this.settings;
    const edges = speakers.map((j) => {
      const known = speaker_identity ? concat(sighted(one.sight(j)), oneHot(j, this.settings.num_agents)) : sighted(one.sight(j));
      const heard = affine(edge, known, undefined, vocabulary);
      for (let k = 0; k < heard.length; k++) heard[k] += edge.weight[k * edge.columns + words[j]];  // the word stands first
      return rectify(heard, heard_slope);
    });
    const asked = affine(query, hidden);
    const shares = softmax(edges.map((vector) => dot(asked, vector) / Math.sqrt(edge.rows)));
    const merged = rectify(affine(merge, concat(hidden, mixture(edges, shares, edge.rows))), heard_slope);
    return { hidden: hidden.map((value, k) => value + merged[k]), shares };
  }

  // `SecondLook`: at the landmarks once more, for what was heard.
  lookAgain(hidden, { places }) {
    if (this.look === null) return { hidden, shares: places.map(() => 0) };
    const { query, merge } = this.look, width = query.rows, asked = affine(query, hidden);
    const sharpness = this.settings.look_sharpness / Math.sqrt(width);
    const shares = softmax(places.map((place) => sharpness * dot(asked, place)));
    const merged = rectify(affine(merge, concat(hidden, mixture(places, shares, width))), this.settings.heard_slope);
    return { hidden: hidden.map((value, k) => value + merged[k]), shares };
  }
}

function nearest(things, count) {
  if (count === null || things.length <= count) return things;
  const farthest = Float64Array.from(things, (thing) => thing.squared).sort()[count - 1];
  return things.filter((thing) => thing.squared <= farthest).slice(0, count);
}

// What one sees of another as numbers for a network; nothing of those that it does not see.
function sighted(sight) {
  if (sight.length === 0) return sight;
  const [x, y, ...features] = sight;
  return Float64Array.of(x, y, Math.sqrt(x * x + y * y + 1e-8), ...features);
}

// The offset, its length, and the offset near by magnified.
function scales(x, y) {
  return Float64Array.of(x, y, Math.sqrt(x * x + y * y + 1e-8), Math.tanh(x / NEAR), Math.tanh(y / NEAR));
}

// A policy out of the page's data: {settings, tensors: {name: [rows, first, size]}, data: base64 of float32}.
export function policyFrom(network) {
  const bytes = Uint8Array.from(atob(network.data), (letter) => letter.charCodeAt(0));
  const numbers = new Float32Array(bytes.buffer), tensors = {}, rows = {};
  for (const [name, [outputs, first, size]] of Object.entries(network.tensors)) {
    tensors[name] = numbers.subarray(first, first + size);
    rows[name] = outputs;
  }
  return new Policy(network.settings, tensors, rows);
}
