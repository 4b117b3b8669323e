// `gacrl.tasks.navigation` in JavaScript: agents without bodies seek goals that others know.

import { actionForces, distanceBetween, integrate, offsetBetween, scatter, thingsAround } from "./physics.js";
import { oneHot } from "./numbers.js";
import { randomNumbers } from "./random.js";

export class NavigationWorld {
  // rules: what `gacrl.tasks.navigation.world` wrote.
  constructor(rules) {
    this.rules = rules;
    this.least = this.most = rules.num_agents;
    this.length = rules.max_cycles;
    this.everyone = Array.from({ length: rules.num_agents }, (_, i) => i);
  }

  reset(seed) {
    const { num_agents, landmarks, named } = this.rules, random = randomNumbers(seed);
    const places = scatter(num_agents + landmarks, 1, random);
    const goals = this.everyone.map(() => Math.floor(random() * landmarks));
    const inOrder = Array.from({ length: landmarks }, (_, l) => l);
    return {
      positions: places.slice(0, 2 * num_agents),
      velocities: new Float64Array(2 * num_agents),
      landmarks: places.slice(2 * num_agents),
      goals,
      order: this.everyone.map(() => (named ? inOrder : shuffled(inOrder, random))),
    };
  }

  step(state, actions) {
    const moved = integrate(state.positions, state.velocities, actionForces(actions, this.rules.physics), this.rules.physics);
    const stays = (k) => !this.rules.moves[k >> 1];
    const after = {
      ...state,
      positions: moved.positions.map((place, k) => (stays(k) ? state.positions[k] : place)),
      velocities: moved.velocities.map((speed, k) => (stays(k) ? state.velocities[k] : speed)),
    };
    return { state: after, ...this.measure(after) };
  }

  // MPE2's reward, the mean over the agents, and the share of those who seek a goal that stand on it.
  measure(state) {
    const { squared, seeks, knows, local_ratio, capture_radius } = this.rules;
    const distance = this.everyone.map((i) => distanceBetween(state.positions, i, state.landmarks, state.goals[i]));
    const lost = distance.map((d) => (squared ? d * d : d));
    const seekers = this.everyone.filter((i) => seeks[i]);
    const mean = seekers.reduce((sum, i) => sum + lost[i], 0) / seekers.length;
    // As NumPy counts from the end: who knows nobody's goal (-1) has the last agent's.
    const known = knows.map((j) => lost.at(j));
    const reward = -known.reduce((sum, of) => sum + local_ratio * of + (1 - local_ratio) * mean, 0) / known.length;
    return { reward, share: seekers.filter((i) => distance[i] < capture_radius).length / seekers.length, collisions: 0 };
  }

  observe(state) {
    return this.everyone.map((i) => this.seenBy(state, i));
  }

  // What an agent sees: its velocity, the landmarks, the goal that it knows, and which agent it is.
  seenBy(state, i) {
    const { landmarks, moves, bodies, identity, num_agents, named, knows, hears } = this.rules;
    const velocity = moves[i] ? [state.velocities[2 * i], state.velocities[2 * i + 1]] : [0, 0];
    const goal = state.order[i].map((l) => Number(knows[i] >= 0 && l === state.goals[knows[i]]));
    const who = identity ? [...oneHot(i, num_agents)] : [];
    const features = (l) => (named ? [...oneHot(l, landmarks)] : [goal[state.order[i].indexOf(l)]]);
    const names = (j) => (identity ? [...oneHot(j, num_agents)] : []);
    return {
      own: named ? [...velocity, ...goal, ...who] : [...velocity, ...who],
      landmarks: moves[i] ? thingsAround(state.positions, i, state.landmarks, features) : [],
      agents: bodies ? thingsAround(state.positions, i, state.positions, names).filter((it) => it.index !== i) : [],
      speakers: hears[i],
      sight: bodies ? (j) => [...offsetBetween(state.positions, i, state.positions, j), ...names(j)] : () => [],
      available: Array.from({ length: 5 }, (_, action) => moves[i] || action === 0),
    };
  }

  look(state) {
    const { seeks, agent_radius, capture_radius } = this.rules;
    const agents = this.everyone.map((i) => ({
      x: state.positions[2 * i], y: state.positions[2 * i + 1], radius: agent_radius, touching: false,
      colour: seeks[i] ? state.goals[i] : -1, goal: seeks[i] ? state.goals[i] : -1,
    }));
    const reached = (l) => this.everyone.some((i) => seeks[i] && state.goals[i] === l
      && distanceBetween(state.positions, i, state.landmarks, l) < capture_radius);
    const marks = Array.from({ length: state.landmarks.length / 2 }, (_, l) => ({
      x: state.landmarks[2 * l], y: state.landmarks[2 * l + 1], radius: capture_radius, colour: l, lit: reached(l),
    }));
    return { agents, marks, ground: [-1, -1, 1, 1] };
  }
}

function shuffled(values, random) {
  return values.map((value) => [random(), value]).sort((a, b) => a[0] - b[0]).map(([, value]) => value);
}
