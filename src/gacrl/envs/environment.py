"""What an environment is: pure functions over one copy, vmapped by whoever needs many."""

import functools
import inspect
import reprlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TypeAlias

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from gacrl.config.checks import require
from gacrl.errors import ConfigError
from gacrl.types import Entities, Metrics, Observation, PRNGKey

EnvState: TypeAlias = Any
EnvParams: TypeAlias = Any
"""A pytree of numbers (physics, difficulty): changing them never recompiles."""


class TimeStep(NamedTuple):
    """What a step brings. The observation is the one before any reset."""

    observation: Observation
    reward: Float[Array, " N"]
    terminated: Bool[Array, ""]
    """The task is over: nothing follows that could be bootstrapped from."""
    truncated: Bool[Array, ""]
    """The time limit was reached: the task would have gone on."""
    info: Metrics = {}  # noqa: RUF012 nobody writes into it
    """Measurements after the step, scalars; `reward_raw` is the mean reward where it is not among them."""
    left: Bool[Array, " N"] | None = None
    """This agent's life ended with the step (a car left, an agent died): its value is not bootstrapped across it, and
    whoever takes its slot remembers nothing. None: lives end with the episode."""


class Environment(ABC):
    """A task for N agents. Write it for one copy; resets after an episode's end are the rollout's.

    A task states its sizes, as fields of a frozen dataclass, class attributes or properties, and has `reset` and
    `step`. Everything else has a default here. An environment is hashable: it is a constant of compiled programs.
    """

    num_agents: int
    num_actions: int
    """Actions of each agent; what an agent cannot do is False in `Observation.action_mask`."""
    observation_size: int
    """O: numbers that each agent sees."""
    max_cycles: int
    """Steps until the time limit."""
    continuous_actions: bool = False
    """Actions are [N, A] numbers in [0, 1] instead of [N] indices; `Observation.action_mask` says which ones count."""
    pushes: ClassVar[bool] = False
    """Continuous actions are MPE2's: no push, then a push in each direction, so that some can be chosen among."""
    num_symmetries: int = 1
    """Rotations and reflections under which the task is the same; 0 is the identity."""
    shortest_truncated: int = 1
    """No episode is truncated before so many steps. Where only the time limit truncates, `max_cycles` says so, and
    learners bootstrap at fewer steps; 1 is right for every task."""
    observes_state: ClassVar[bool] = False
    """Whether `observe_many` makes observations from states, which is then cheaper than to hand them through."""

    hosted: ClassVar[bool] = False
    """It lives in Python, and no program can step it (`envs.hosted`)."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if inspect.isfunction(vars(cls).get("step")):
            cls.step = _refusing_odd_actions(cls.step)

    def default_params(self) -> EnvParams:
        """Return the numbers of the task, where it has some."""
        return ()

    @abstractmethod
    def reset(self, key: PRNGKey, params: EnvParams = ()) -> tuple[EnvState, Observation]:
        """Begin an episode."""

    @abstractmethod
    def step(
        self, state: EnvState, action: Array, key: PRNGKey, params: EnvParams = ()
    ) -> tuple[EnvState, TimeStep]:
        """Let every agent act once. action: [N] indices, or [N, A] numbers in [0, 1].

        Raises ConfigError for an action out of range, where its numbers are known: not inside a compiled program.
        """

    def from_features(self, features: Float[Array, "N O"]) -> Observation:
        """Return the observation around bare feature vectors, as other programs hand them out: everyone is there, and
        may do everything.
        """
        return observe(features, num_actions=self.num_actions)

    def stack(self, rows: Sequence[Any]) -> Float[np.ndarray, "N O"]:
        """Stack what the agents see, as other programs hand it out one by one.

        Raises ConfigError where it does not fit.
        """
        rows = [as_floats(row).reshape(-1) for row in rows]
        sizes = [row.size for row in rows]
        require(
            sizes == [self.observation_size] * self.num_agents,
            f"observations must hold {self.observation_size} numbers for each of {self.num_agents} agents, not {sizes}",
        )
        return np.stack(rows)

    def unstack(self, actions: Array | np.ndarray) -> list[Any]:
        """Return the agents' actions as other programs take them, one by one."""
        return [int(action) for action in actions] if actions.ndim == 1 else list(np.asarray(actions))

    def entities(self, observation: Observation) -> Entities:
        """Take apart what is seen, for graph networks. By default an agent is alone with its features."""
        num_agents = observation.features.shape[0]
        nothing, nobody = jnp.zeros((num_agents, 0, 2)), jnp.zeros((num_agents, 0), bool)
        return Entities(observation.features, nothing, nothing, nobody, nobody)

    def sight(self, observation: Observation) -> Float[Array, "N N S"]:
        """Return what each agent itself sees of each other one: entry [i, j] is the offset from i to j, then features.

        Messages arrive with it. By default it is what `entities` says of the other agents, where those are all others
        in order, and 0 of those out of sight. Otherwise S = 0: voices cannot be told apart by where they come from.
        """
        seen = self.entities(observation)
        num_agents, others = seen.agents.shape[:2]
        if others == 0 or others != num_agents - 1:
            return jnp.zeros((num_agents, num_agents, 0))
        known = [seen.agents] if seen.agent_features is None else [seen.agents, seen.agent_features]
        return with_self(jnp.where(seen.agent_mask[..., None], jnp.concatenate(known, axis=-1), 0.0))

    def telling(self, observation: Observation) -> Float[Array, "N O"]:
        """Return what each agent tells where all that it sees is told: by default its observation as it is."""
        return observation.features

    def turn(self, observation: Observation, symmetry: Int[Array, ""]) -> Observation:
        """Return the observation of the turned world."""
        return observation

    def turn_action(self, action: Array, symmetry: Int[Array, ""]) -> Array:
        """Return the action that does in the turned world what this one does here."""
        return action

    def idle(self) -> Float[np.ndarray, "N A"]:
        """Return continuous actions that do nothing: by default pushes of 0."""
        return np.zeros((self.num_agents, self.num_actions), np.float32)

    def step_many(
        self,
        state: EnvState,
        action: Array,
        keys: Key[Array, " E"] | UInt32[Array, "E _"],
        params: EnvParams = (),
    ) -> tuple[EnvState, TimeStep]:
        """Step E copies. A task may know a quicker way than to map its step."""
        return jax.vmap(self.step, (0, 0, 0, None))(state, action, keys, params)

    def observe_many(self, state: EnvState, params: EnvParams = ()) -> Observation:
        """Return what is seen in each of E states, for a task that `observes_state`."""
        raise NotImplementedError

    def seen_in(self, state: EnvState, params: EnvParams = ()) -> Observation | None:
        """Return what is seen in a state that a hand has changed; None where only the next step can tell."""
        if not self.observes_state:
            return None
        one = jax.tree.map(lambda leaf: leaf[None], state)
        return jax.tree.map(lambda leaf: leaf[0], self.observe_many(one, params))


def typed_keys(keys: Array) -> Key[Array, "..."]:
    """Return keys as JAX's key arrays, whose shape is that of the copies; those of `jax.random.PRNGKey` are wrapped."""
    return keys if jnp.issubdtype(keys.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(keys)


def observe(
    features: Float[Array, "N O"],
    *,
    num_actions: int | None = None,
    positions: Float[Array, "N 2"] | None = None,
    alive: Bool[Array, " N"] | None = None,
    available: Bool[Array, "N A"] | None = None,
    adjacency: Bool[Array, "N N"] | None = None,
    state: Float[Array, " S"] | None = None,
) -> Observation:
    """Make an observation and fill its masks.

    alive: which agents are there; all by default. available: which actions each agent has; all of `num_actions` by
    default. adjacency: entry [i, j] lets i hear j; by default everyone in reach does. state: what a central critic may
    know; by default all features side by side. Raises ValueError where neither num_actions nor available is given.
    """
    num_agents = features.shape[0]
    if available is None:
        if num_actions is None:
            raise ValueError("observe needs num_actions, or available [N, A]")
        available = jnp.ones((num_agents, num_actions), bool)
    return Observation(
        features=features,
        positions=positions,
        agent_mask=jnp.ones(num_agents, bool) if alive is None else alive,
        landmark_mask=None,
        action_mask=available,
        adjacency=adjacency,
        state=state,
    )


def with_self(pairs: Float[Array, "N M F"]) -> Float[Array, "N N F"]:
    """Insert an entry i of zeros into row i of what N agents have for each of M = N - 1 others in order."""
    size, rest = pairs.shape[0], pairs.shape[2:]
    rows = pairs.reshape(size - 1, size, *rest)  # in one long row, entry i of row i is every (N + 1)st
    rows = jnp.pad(rows, ((0, 0), (0, 1), *[(0, 0)] * len(rest))).reshape(size * size - 1, *rest)
    return jnp.pad(rows, ((1, 0), *[(0, 0)] * len(rest))).reshape(size, size, *rest)


def side_by_side(seen: Sequence[Float[Array, " _"]], roles: Sequence[int] | None = None) -> Float[Array, "N O"]:
    """Lay out features of agents that see different things: numbers padded with zeros to the longest.

    roles: an index for each agent, appended as a one-hot, so that shared weights can tell the agents apart; by default
    every agent has a role of its own.
    """
    roles = range(len(seen)) if roles is None else roles
    length = max(numbers.shape[0] for numbers in seen)
    rows = jnp.stack([jnp.pad(numbers, (0, length - numbers.shape[0])) for numbers in seen])
    return jnp.concatenate([rows, jax.nn.one_hot(jnp.asarray(list(roles)), max(roles) + 1)], axis=1)


def _refusing_odd_actions(step: Callable[..., Any]) -> Callable[..., Any]:
    """The same step, that refuses actions out of range. Traced ones pass: a compiled program has no check in it."""

    @functools.wraps(step)
    def checked(self: Environment, *given: Any, **named: Any) -> Any:
        action = given[1] if len(given) > 1 else named.get("action")
        known = action is not None and not any(
            isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(action)
        )
        if known:
            _require_actions(self, action)
        return step(self, *given, **named)

    return checked


def _require_actions(env: Environment, action: Any) -> None:
    continuous, numbers = env.continuous_actions, as_floats(action, "actions")
    shape = (env.num_agents, env.num_actions) if continuous else (env.num_agents,)
    fits = numbers.shape[: len(shape)] == shape  # copies may stand behind
    require(fits, f"actions must have the shape {list(shape)}, not {list(numbers.shape)}")
    highest = 1 if continuous else env.num_actions - 1
    wanted = f"numbers between 0 and {highest}" if continuous else f"whole numbers from 0 to {highest}"
    odd = ~((numbers >= 0) & (numbers <= highest))
    if not continuous:
        odd |= numbers != np.round(numbers)
    if odd.any():
        place = tuple(np.argwhere(odd)[0])
        raise ConfigError(f"the action of agent {place[0]} is {numbers[place]:g}: actions are {wanted}")


def as_floats(numbers: Any, what: str = "observations") -> np.ndarray:
    """Return numbers as an array of float32. Raises ConfigError for what are none."""
    try:
        return np.asarray(numbers, np.float32)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{what} must be an array of numbers, not {reprlib.repr(numbers)}") from error
