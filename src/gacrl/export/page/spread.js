// `gacrl.tasks.spread` in JavaScript: agents must stand on landmarks without touching each other.

import { actionForces, addContactForces, distanceBetween, integrate, offsetBetween, scatter, thingsAround } from "./physics.js";
import { randomNumbers } from "./random.js";

export class SpreadWorld {
  // rules: what `gacrl.tasks.spread.world` wrote.
  constructor(rules) {
    this.rules = rules;
    this.least = rules.least_agents;
    this.most = rules.most_agents;
    this.length = rules.max_cycles;
    this.reaches = true;
    this.available = Array.from({ length: 5 }, () => true);
  }

  // Crowded as in training: the area grows with the agents.
  scale(count) {
    return this.rules.arena_scale * Math.sqrt(count / this.rules.num_agents);
  }

  reset(seed, count) {
    const random = randomNumbers(seed), scale = this.scale(count), landmarks = this.landmarksFor(count);
    const positions = scatter(count, scale, random), places = scatter(landmarks, scale, random);
    return { positions, velocities: new Float64Array(2 * count), landmarks: places };
  }

  landmarksFor(count) {
    return this.rules.num_landmarks ?? count;
  }

  step(state, actions) {
    const forces = actionForces(actions, this.rules.physics);
    addContactForces(forces, state.positions, this.rules.physics);
    const moved = { ...integrate(state.positions, state.velocities, forces, this.rules.physics), landmarks: state.landmarks };
    return { state: moved, ...this.measure(moved) };
  }

  // MPE2's reward, the mean over the agents; the share of landmarks that are covered; pairs that touch.
  measure(state) {
    const agents = state.positions.length / 2, landmarks = state.landmarks.length / 2;
    let away = 0, covered = 0, pairs = 0;
    for (let l = 0; l < landmarks; l++) {
      const nearest = this.nearest(state, l);
      away += nearest;
      covered += nearest < this.rules.capture_radius;
    }
    for (let i = 0; i < agents; i++) {
      for (let j = 0; j < i; j++) {
        pairs += distanceBetween(state.positions, i, state.positions, j) < 2 * this.rules.physics.agent_radius;
      }
    }
    return { reward: 0.5 * ((-2 * pairs) / agents) - 0.5 * away, share: covered / landmarks, collisions: pairs };
  }

  // How far the nearest agent is from a landmark.
  nearest(state, landmark) {
    let least = Infinity;
    for (let i = 0; i < state.positions.length / 2; i++) {
      least = Math.min(least, distanceBetween(state.positions, i, state.landmarks, landmark));
    }
    return least;
  }

  // What each agent sees, for networks over graphs of entities, and who hears whom.
  observe(state, radius) {
    return Array.from({ length: state.positions.length / 2 }, (_, i) => {
      const agents = thingsAround(state.positions, i, state.positions);
      agents.splice(i, 1);
      return {
        own: [state.velocities[2 * i], state.velocities[2 * i + 1]],
        // MPE2 pads with zeros: what is at distance 0 is not there. It is heard all the same.
        landmarks: thingsAround(state.positions, i, state.landmarks).filter((it) => it.squared > 0),
        agents: agents.filter((it) => it.squared > 0),
        speakers: agents.filter((it) => it.squared < radius * radius).map((it) => it.index),
        sight: (j) => offsetBetween(state.positions, i, state.positions, j),
        available: this.available,
      };
    });
  }

  look(state) {
    const corner = this.scale(state.positions.length / 2);
    const agents = Array.from({ length: state.positions.length / 2 }, (_, i) => ({
      x: state.positions[2 * i], y: state.positions[2 * i + 1], radius: this.rules.physics.agent_radius, colour: -1, goal: -1,
    }));
    const marks = Array.from({ length: state.landmarks.length / 2 }, (_, l) => ({
      x: state.landmarks[2 * l], y: state.landmarks[2 * l + 1], radius: this.rules.capture_radius, colour: -1,
      lit: this.nearest(state, l) < this.rules.capture_radius,
    }));
    for (const [i, agent] of agents.entries()) {
      agent.touching = agents.some((_, j) => j !== i
        && distanceBetween(state.positions, i, state.positions, j) < 2 * this.rules.physics.agent_radius);
    }
    return { agents, marks, ground: [-corner, -corner, corner, corner] };
  }

  // One more agent, and a landmark where every agent has one; random: where.
  add(state, random) {
    const count = state.positions.length / 2 + 1, scale = this.scale(count);
    const landmarks = this.landmarksFor(count) - state.landmarks.length / 2;
    return {
      positions: Float64Array.of(...state.positions, ...scatter(1, scale, random)),
      velocities: Float64Array.of(...state.velocities, 0, 0),
      landmarks: Float64Array.of(...state.landmarks, ...scatter(landmarks, scale, random)),
    };
  }

  // Without the last agent, and without the last landmark where every agent has one.
  remove(state) {
    const count = state.positions.length / 2 - 1;
    return {
      positions: state.positions.slice(0, -2),
      velocities: state.velocities.slice(0, -2),
      landmarks: state.landmarks.slice(0, 2 * this.landmarksFor(count)),
    };
  }
}
