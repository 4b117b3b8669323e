"""Policies of `spread` that learn nothing: a ceiling, `oracle`, and `local`, which sees little.

The oracle reads the exact state, whatever the agents themselves observe. It assigns agents to landmarks once
per episode, at the least total squared distance. Then each agent takes the push after which it would coast
nearest to its target, where crowding another agent counts as distance. Targets leave room for two discs;
landmarks need not. It is a strong heuristic and no optimum: a learned policy may beat it.

The local one moves as the oracle does, but matches only what it has in sight, nearest pairs first, and anew in every
step: what can be had in a large team without a view of the whole and without a word.

Physics and arena scale, which no observation tells, they take from the environment's settings; masks, places and
velocities of agents and landmarks from the observation.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from gacrl.envs.particles import DIRECTIONS, Physics, along, coast, pairwise_offsets
from gacrl.tasks.spread.assignment import assign
from gacrl.tasks.spread.environment import (
    CAPTURE_RADIUS,
    Spread,
    SpreadParams,
    SpreadState,
    reflect,
    unpack_state,
)
from gacrl.tasks.spread.scouts import Scouts
from gacrl.types import Actor, Decision, Memory, Observation, PRNGKey

SIGHT = 5
"""The local policy sees this many nearest landmarks, and as many nearest agents."""

UNASSIGNED = -2
"""The oracle's memory before an episode's first step; -1 is `assign`'s mark of an agent without landmark."""
SHARED_DISTANCE = 0.17
"""Landmarks this close get one agent, midway: it covers both, where two agents would push each other off."""
SHIFT = 0.95 * CAPTURE_RADIUS
"""How far a target may move off its landmark and still be sure to cover it."""
WALKING = 0.2
"""What a unit of way costs, as a share of a unit that a landmark stays uncovered, where not all can be covered."""
ELBOW_ROOM = 0.02
"""Agents keep this far apart, disc to disc, unless it costs them as much in distance to their targets."""


def oracle(env: Spread) -> Actor:
    """Go to one's landmark, which is the memory [N], fixed from the episode's first step on."""
    return _planner(env, lambda to_posts, posts, wanted: jnp.square(to_posts), None)


def silent(env: Scouts) -> Actor:
    """Make the blind stay where they are, while those who see cover the landmarks that are worth it.

    A landmark that is left to a blind agent costs its distance to the nearest thing that will stand: that agent, or the
    agent of another landmark.
    """
    blind = jnp.asarray(env.blind)

    def cost(to_posts: Float[Array, "N L"], posts: Float[Array, "L 2"], wanted: Bool[Array, " L"]) -> Array:
        _, between = pairwise_offsets(posts, posts)
        left = jnp.minimum(to_posts, jnp.where(_pairs(wanted), between, jnp.inf).min(1)[None])
        return jnp.where(blind[:, None], left, WALKING * to_posts)

    planned = _planner(env, cost, blind)

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        decision, memory = planned.policy(memory, observation, key)
        return decision._replace(action=jnp.where(along(blind, decision.action), 0, decision.action)), memory

    return Actor(policy, planned.initial_memory)


def _planner(
    env: Spread,
    cost: Callable[[Float[Array, "N L"], Float[Array, "L 2"], Bool[Array, " L"]], Float[Array, "N L"]],
    stays: Bool[Array, " N"] | None,
) -> Actor:
    """Assign landmarks once an episode, and walk there. Memory: each agent's landmark [N].

    cost: from each agent's distance to each post, the posts, and which want an agent of their own.
    stays: who goes nowhere.
    """
    params = env.default_params()

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        if observation.state is None:
            raise ValueError("The oracle needs an environment that puts its state into the observation.")
        state = unpack_state(observation.state, env.num_agents)
        agents, motion = observation.agent_mask, state.landmark_velocities
        posts, wanted = _posts(state, _landmarks(observation))

        def assign_agents(memory: Int[Array, " N"]) -> Int[Array, " N"]:
            origins = state.positions[:, None]
            meeting = jax.vmap(_intercept, (0, None, None, None))(origins, posts, motion, params)
            costs = cost(_length(meeting - origins), posts, wanted)
            possible = (agents & (memory == UNASSIGNED))[:, None] & wanted[None, :]
            return assign(jnp.where(possible, costs, jnp.inf))

        # A loop that runs once at most: mapped over environments, `cond` would assign in every step and select.
        # The body depends on the memory, because XLA moves constant work out, in front of the loop.
        landmark = lax.while_loop(lambda memory: (memory == UNASSIGNED).any(), assign_agents, memory)

        free = ~(agents & (landmark >= 0) & wanted[landmark])
        free = free if stays is None else free | stays
        coasting, _ = coast(state.positions, state.velocities, params.physics)
        target = _intercept(coasting, posts[landmark], motion[landmark], params)
        return Decision(_steer(env, state, agents, target, free)), landmark

    return Actor(policy, jnp.full(env.num_agents, UNASSIGNED, jnp.int32))


def local(env: Spread) -> Actor:
    """Let each agent decide anew in every step, from the nearest landmarks and agents alone."""

    def policy(memory: Memory, observation: Observation, key: PRNGKey):
        if observation.state is None:
            raise ValueError("The local policy needs an environment that puts its state into the observation.")
        state = unpack_state(observation.state, env.num_agents)
        agents = observation.agent_mask
        _, distance = pairwise_offsets(state.positions, state.landmarks)
        distance = jnp.where(_landmarks(observation), distance, jnp.inf)
        _, between = pairwise_offsets(state.positions, state.positions)
        between = jnp.where(_pairs(agents), between, jnp.inf)
        nearest = lax.top_k(-distance, min(SIGHT, env.landmarks))[1]  # [N K]
        others = lax.top_k(-between, min(SIGHT, env.num_agents - 1))[1]
        there = jnp.take_along_axis(between, others, axis=1) < jnp.inf
        group = jnp.concatenate([jnp.arange(env.num_agents)[:, None], others], axis=1)  # [N M], itself first
        theirs = distance[group[:, :, None], nearest[:, None, :]]  # [N M K]
        hidden = jnp.concatenate([jnp.zeros((env.num_agents, 1), bool), ~there], axis=1)
        choice = jax.vmap(_greedy_match)(jnp.where(hidden[..., None], jnp.inf, theirs))
        target = state.landmarks[jnp.take_along_axis(nearest, choice[:, None], axis=1)[:, 0]]
        return Decision(_steer(env, state, agents, target, ~agents)), memory

    return Actor(policy, ())


def _landmarks(observation: Observation) -> Bool[Array, " L"]:
    """Which landmarks there are."""
    assert observation.landmark_mask is not None  # spread always shows it
    return observation.landmark_mask


def _greedy_match(distance: Float[Array, "M K"]) -> Int[Array, ""]:
    """The landmark of the first agent when the closest pair is matched first, and so on.

    Where it is left without one: the last, the farthest in sight, away from the crowd.
    """
    num_landmarks = distance.shape[1]

    def match(_: Int[Array, ""], loop: tuple[Array, Array]) -> tuple[Array, Array]:
        left, mine = loop
        agent, landmark = jnp.divmod(left.argmin(), num_landmarks)
        mine = jnp.where((agent == 0) & (left[agent, landmark] < jnp.inf), landmark, mine)
        return left.at[agent].set(jnp.inf).at[:, landmark].set(jnp.inf), mine

    start = distance, jnp.asarray(num_landmarks - 1)
    return lax.fori_loop(0, min(distance.shape), match, start)[1]


def _steer(
    env: Spread,
    state: SpreadState,
    agents: Bool[Array, " N"],
    target: Float[Array, "N 2"],
    free: Bool[Array, " N"],
) -> Array:
    """The actions that bring agents to their targets, out of each other's way; `free` ones stay where they like."""
    physics = env.default_params().physics
    coasting, reach = coast(state.positions, state.velocities, physics)
    target = _make_room(jnp.where(free[:, None], coasting, target), free, agents, physics)
    pushes = _pushes((target - coasting) / reach, env.continuous_actions)
    outcomes = coasting[:, None] + reach * pushes
    distance = _length(outcomes - target[:, None])
    # The others are expected halfway between coasting on and what each would do if it were alone.
    expected = (coasting + _row_choice(outcomes, distance.argmin(axis=1))) / 2
    choice = (distance + _crowding(outcomes, expected, agents, physics)).argmin(axis=1)
    return _as_action(_row_choice(pushes, choice), env.continuous_actions)


def _posts(state: SpreadState, landmark_mask: Bool[Array, " L"]) -> tuple[Float[Array, "L 2"], Bool[Array, " L"]]:
    """Where to stand to cover each landmark, and which landmarks want an agent of their own.

    Two landmarks that are each other's nearest share a post midway if they are close and stay together:
    what they drift apart in one unit of time (ten steps) adds to their distance. One of them wants the agent.
    """
    index = jnp.arange(state.landmarks.shape[0])
    _, distance = pairwise_offsets(state.landmarks, state.landmarks)
    _, drift = pairwise_offsets(state.landmark_velocities, state.landmark_velocities)
    apart = jnp.where(_pairs(landmark_mask), distance + drift, jnp.inf)
    partner = apart.argmin(axis=1)
    shared = (partner[partner] == index) & (apart.min(axis=1) < SHARED_DISTANCE)
    midway = (state.landmarks + state.landmarks[partner]) / 2
    wanted = landmark_mask & ~(shared & (partner < index))
    return jnp.where(shared[:, None], midway, state.landmarks), wanted


def _intercept(
    start: Float[Array, "#M 2"], posts: Float[Array, "M 2"], motion: Float[Array, "M 2"], params: SpreadParams
) -> Float[Array, "M 2"]:
    """Where agents at top speed meet their moving posts, no sooner than `coast` looks ahead."""
    meeting = posts
    for _ in range(2):  # time from place, place from time, and once more
        time = _length(meeting - start) / params.physics.top_speed + 3 * params.physics.time_step
        meeting, _ = reflect(posts + time[:, None] * motion, motion, params.arena_scale)
    return meeting


def _make_room(
    targets: Float[Array, "N 2"], free: Bool[Array, " N"], agent_mask: Bool[Array, " N"], physics: Physics
) -> Float[Array, "N 2"]:
    """Pushes targets apart that two agents could not stand on: by up to SHIFT, by any length where free."""
    offsets, distance = pairwise_offsets(targets, targets)
    room = 2 * (physics.agent_radius + physics.contact_margin)
    overlap = jnp.where(_pairs(agent_mask), jnp.maximum(room - distance, 0.0), 0.0)
    shift = -(offsets * (overlap / 2 / jnp.maximum(distance, 1e-6))[..., None]).sum(1)
    length = jnp.maximum(_length(shift), 1e-6)
    return targets + shift * jnp.minimum(1.0, jnp.where(free, jnp.inf, SHIFT) / length)[:, None]


def _pushes(exact: Float[Array, "N 2"], continuous: bool) -> Float[Array, "N C 2"]:
    """Each agent's candidates, in units of the full force: the directions, and the exact push if it may."""
    directions = jnp.broadcast_to(jnp.asarray(DIRECTIONS), (exact.shape[0], len(DIRECTIONS), 2))
    if not continuous:
        return directions
    return jnp.concatenate([directions, jnp.clip(exact, -1.0, 1.0)[:, None]], axis=1)


def _crowding(
    places: Float[Array, "N C 2"],
    others: Float[Array, "N 2"],
    agent_mask: Bool[Array, " N"],
    physics: Physics,
) -> Float[Array, "N C"]:
    """How far each place is inside the discs and the elbow room of the other agents, summed over them."""
    distance = _length(places[:, :, None] - others[None, None])
    depth = jnp.maximum(2 * physics.agent_radius + ELBOW_ROOM - distance, 0.0)
    return jnp.where(_pairs(agent_mask)[:, None], depth, 0.0).sum(-1)


def _as_action(push: Float[Array, "N 2"], continuous: bool) -> Int[Array, " N"] | Float[Array, "N 5"]:
    """The action whose force is the push, in units of the full force; the nearest one if discrete."""
    along = push @ jnp.asarray(DIRECTIONS).T
    return jnp.maximum(along, 0.0) if continuous else along.argmax(axis=1)


def _pairs(mask: Bool[Array, " M"]) -> Bool[Array, "M M"]:
    """Which entries are two different real ones."""
    return mask[:, None] & mask[None, :] & ~jnp.eye(mask.shape[0], dtype=bool)


def _row_choice(options: Float[Array, "N C 2"], choice: Int[Array, " N"]) -> Float[Array, "N 2"]:
    return jnp.take_along_axis(options, choice[:, None, None], axis=1)[:, 0]


def _length(vectors: Float[Array, "*b 2"]) -> Float[Array, "*b"]:
    """Written out, because XLA does not vectorise a sum over so short an axis on CPUs (50 times slower)."""
    return jnp.sqrt(jnp.square(vectors[..., 0]) + jnp.square(vectors[..., 1]))
