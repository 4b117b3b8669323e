"""Policies that learn nothing: the floor (`random`, `noop`) and a strong heuristic, `oracle`.

The oracle sees the exact state. It assigns agents to landmarks once per episode, at the least total distance,
and then every agent takes the action after which it would come to rest nearest to its target, while it
shuns the others. Where landmarks lie so close that two agents could not stand on both, it shifts the targets,
or sends one agent in between. It is no optimum: a learned policy may beat it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.assignment import assign
from gacrl.envs.particles import DIRECTIONS, DOWN, LEFT, RIGHT, UP, Physics, pairwise_offsets
from gacrl.envs.spread import CAPTURE_RADIUS, Spread, SpreadState, reflect, unpack_state
from gacrl.types import Channel, Decision, Memory, Observation, Policy, PRNGKey

SCRIPTED = ("random", "noop", "oracle")

FREE, UNASSIGNED = -1, -2
T = dict(shared=0.15, slack=0.005, elbow=0.03, weight=1.0, glide=1.75, metric='l2', pairlead=1,power=2,iters=2, oneslack=0.0, relax=4, mass=0.02, merge="later", lead=1.0, freegive=10.0, soft="lin", others=0.0)


class Scripted(NamedTuple):
    """A policy, and its memory at the start of an episode, for one environment."""

    policy: Policy
    initial_memory: Memory


def make(name: str, env: Spread) -> Scripted:
    if name == "random":
        return Scripted(_random(env), ())
    if name == "noop":
        return Scripted(_noop(env), ())
    if name == "oracle":
        return Scripted(_oracle(env), jnp.full(env.num_agents, UNASSIGNED, jnp.int32))
    raise ValueError(f"There is no scripted policy {name!r}; there are {', '.join(SCRIPTED)}.")


def _random(env: Spread) -> Policy:
    def policy(memory, observation, key, channel):
        shape = (env.num_agents, env.num_actions)
        if env.continuous_actions:
            return Decision(jax.random.uniform(key, shape)), memory
        return Decision(jax.random.randint(key, shape[:1], 0, shape[1])), memory

    return policy


def _noop(env: Spread) -> Policy:
    def policy(memory, observation, key, channel):
        if env.continuous_actions:
            return Decision(jnp.zeros((env.num_agents, env.num_actions))), memory
        return Decision(jnp.zeros(env.num_agents, jnp.int32)), memory

    return policy


def _oracle(env: Spread) -> Policy:
    physics, limit = env.initial_params.physics, env.initial_params.arena_scale

    def policy(memory, observation, key, channel):
        state = unpack_state(observation.state, env.num_agents)
        middle, spare = _meeting_points(state, observation.landmark_mask)

        def assign_all(_):
            distance = _pair_time(state, middle, limit, physics) ** T["power"]
            wanted = observation.landmark_mask & ~spare
            possible = observation.agent_mask[:, None] & wanted[None, :]
            landmark = assign(jnp.where(possible, distance, jnp.inf))
            return jnp.where(observation.agent_mask & wanted[landmark], landmark, FREE)

        landmark = lax.while_loop(lambda memory: (memory == UNASSIGNED).any(), assign_all, memory)
        free = landmark == FREE
        gliding = _glide(state.positions, state.velocities, physics)
        ahead = _ahead(gliding, middle[landmark], state.landmark_velocities[landmark], limit, physics)
        target = jnp.where(free[:, None], gliding, ahead)
        target = _make_room(target, free, observation.agent_mask, physics)
        pushes = _pushes(target, gliding, physics, env.continuous_actions)
        outcome = gliding[:, None] + T["glide"] * physics.time_step**2 * physics.action_force * pushes
        off = jnp.linalg.norm(outcome - target[:, None], axis=-1)
        free_choice = jnp.take_along_axis(outcome, off.argmin(axis=1)[:, None, None], axis=1)[:, 0]
        others = gliding + T["others"] * (free_choice - gliding)
        cost = off + T["weight"] * _crowding(outcome, others, observation.agent_mask, physics)
        best = jnp.argmin(cost, axis=1)
        if not env.continuous_actions:
            return Decision(best.astype(jnp.int32)), landmark
        push = jnp.take_along_axis(pushes, best[:, None, None], axis=1)[:, 0]
        action = jnp.zeros((env.num_agents, env.num_actions)).at[:, jnp.array([RIGHT, UP])].set(jnp.maximum(push, 0.0))
        action = action.at[:, jnp.array([LEFT, DOWN])].set(jnp.maximum(-push, 0.0))
        return Decision(action), landmark

    return policy


def _norm(x):
    if T["metric"] == "l1":
        return jnp.abs(x).sum(-1)
    if T["metric"] == "max":
        return jnp.abs(x).max(-1)
    return jnp.sqrt(jnp.square(x).sum(-1))


def _ahead(gliding, place, velocity, limit, physics):
    where = place
    for _ in range(T["iters"]):
        lead = _norm(where - gliding)[..., None] / physics.top_speed + 3 * physics.time_step
        where, _ = reflect(place + T["lead"] * lead * velocity, jnp.broadcast_to(velocity, place.shape), limit)
    return where


def _pair_time(state, middle, limit, physics):
    a, b = state.positions[:, None], jnp.broadcast_to(middle[None], (state.positions.shape[0], *middle.shape))
    if T["pairlead"]:
        b = _ahead(a, b, state.landmark_velocities[None], limit, physics)
    return _norm(b - a)


def _glide(positions, velocities, physics):
    dt = physics.time_step
    return positions + dt * velocities + T["glide"] * dt * (1 - physics.damping) * velocities


def _meeting_points(state: SpreadState, mask):
    """Middle"""
    num = state.landmarks.shape[0]
    _, distance = pairwise_offsets(state.landmarks, state.landmarks)
    if T["merge"] == "later":
        later = state.landmarks + 1.0 * state.landmark_velocities
        distance = jnp.maximum(distance, pairwise_offsets(later, later)[1])
    pairs = mask[:, None] & mask[None, :] & ~jnp.eye(num, dtype=bool)
    distance = jnp.where(pairs, distance, jnp.inf)
    nearest = distance.argmin(axis=1)
    index = jnp.arange(num)
    merged = (nearest[nearest] == index) & (distance.min(axis=1) < T["shared"])
    middle = jnp.where(merged[:, None], (state.landmarks + state.landmarks[nearest]) / 2, state.landmarks)
    return middle, merged & (nearest < index)


def _make_room(target, free, mask, physics):
    wish = target
    room = 2 * physics.agent_radius + 0.002
    give = jnp.where(free, T["freegive"], CAPTURE_RADIUS - T["slack"])[:, None]
    pairs = mask[:, None] & mask[None, :] & ~jnp.eye(target.shape[0], dtype=bool)

    def push(_, target):
        offsets, distance = pairwise_offsets(target, target)
        overlap = jnp.where(pairs, jnp.maximum(room - distance, 0.0), 0.0)
        shift = -(offsets * (overlap / jnp.maximum(distance, 1e-6) / 2)[..., None]).sum(1)
        moved = target + shift - wish
        length = jnp.linalg.norm(moved, axis=1, keepdims=True)
        return wish + moved * jnp.minimum(1.0, give / jnp.maximum(length, 1e-6))

    return lax.fori_loop(0, T["relax"], push, target)


def _pushes(target, gliding, physics, continuous):
    pushes = jnp.broadcast_to(jnp.asarray(DIRECTIONS), (target.shape[0], len(DIRECTIONS), 2))
    if not continuous:
        return pushes
    exact = (target - gliding) / (T["glide"] * physics.time_step**2 * physics.action_force)
    return jnp.concatenate([pushes, jnp.clip(exact, -1, 1)[:, None]], axis=1)


def _crowding(outcome, gliding, mask, physics):
    comfort = 2 * physics.agent_radius + T["elbow"]
    offsets = outcome[:, :, None] - gliding[None, None]
    distance = jnp.sqrt(jnp.square(offsets).sum(-1))
    between = mask[:, None] & mask[None, :] & ~jnp.eye(mask.shape[0], dtype=bool)
    inside = jnp.where(between[:, None], jnp.maximum(comfort - distance, 0.0), 0.0)
    return inside.sum(-1)
