// The particle world of MPE, as `gacrl.envs.particles`: damped point masses that push each other apart on contact.
// A place is two neighbouring numbers of a flat array: x of thing k at 2k, y at 2k + 1.

export const NO_ACTION = 0;
export const DIRECTIONS = [[0, 0], [-1, 0], [1, 0], [0, -1], [0, 1]];

export function distanceBetween(a, i, b, j) {
  return Math.hypot(a[2 * i] - b[2 * j], a[2 * i + 1] - b[2 * j + 1]);
}

// From place i of a to place j of b.
export function offsetBetween(a, i, b, j) {
  return [b[2 * j] - a[2 * i], b[2 * j + 1] - a[2 * i + 1]];
}

const NO_FEATURES = new Float64Array(0);

// The things at these places as agent i sees them: how far to the right and up, and what is known of them besides.
export function thingsAround(positions, i, places, features = () => NO_FEATURES) {
  const things = [];
  for (let index = 0; index < places.length / 2; index++) {
    const x = places[2 * index] - positions[2 * i], y = places[2 * index + 1] - positions[2 * i + 1];
    things.push({ index, x, y, squared: x * x + y * y, features: features(index) });
  }
  return things;
}

// The force of each agent's own action, flat.
export function actionForces(actions, physics) {
  const forces = new Float64Array(2 * actions.length);
  actions.forEach((action, agent) => {
    forces[2 * agent] = physics.action_force * DIRECTIONS[action][0];
    forces[2 * agent + 1] = physics.action_force * DIRECTIONS[action][1];
  });
  return forces;
}

// Adds the force of each contact: a softplus of the penetration. At the very same point there is no direction: no force.
export function addContactForces(forces, positions, physics) {
  const margin = physics.contact_margin, touching = 2 * physics.agent_radius, count = positions.length / 2;
  for (let i = 0; i < count; i++) {
    for (let j = 0; j < i; j++) {
      const [dx, dy] = offsetBetween(positions, i, positions, j), distance = Math.hypot(dx, dy);
      if (distance === 0 || distance > touching + 100 * margin) continue;
      const depth = (touching - distance) / margin;
      const penetration = margin * (Math.max(depth, 0) + Math.log1p(Math.exp(-Math.abs(depth))));
      const strength = (physics.contact_force * penetration) / distance;
      forces[2 * i] -= strength * dx;
      forces[2 * i + 1] -= strength * dy;
      forces[2 * j] += strength * dx;
      forces[2 * j + 1] += strength * dy;
    }
  }
}

// One step: positions move with the old velocity, then velocities are damped and pushed (mass 1).
export function integrate(positions, velocities, forces, physics) {
  return {
    positions: positions.map((place, k) => place + velocities[k] * physics.time_step),
    velocities: velocities.map((speed, k) => speed * (1 - physics.damping) + forces[k] * physics.time_step),
  };
}

// Places drawn uniformly in [-scale, scale] squared.
export function scatter(count, scale, random) {
  return Float64Array.from({ length: 2 * count }, () => (2 * random() - 1) * scale);
}
