"""What is done to messages, against numbers worked out by hand: agents of whom a second word depends on the first ones."""

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn_learner

from gacrl import rollout
from gacrl.algorithms import build as algorithms
from gacrl.config.algorithms import DialConfig, GacrlPaperConfig, MappoConfig, NetworkConfig
from gacrl.config.run import TrainingConfig
from gacrl.envs.environment import Environment, TimeStep, observe
from gacrl.errors import ConfigError
from gacrl.evaluation import references
from gacrl.evaluation.episodes import record_many
from gacrl.evaluation.evaluate import evaluate
from gacrl.messages import interventions
from gacrl.networks.arrives import arriving
from gacrl.networks.graph import heard_adjacency
from gacrl.tasks.spread.environment import Spread
from gacrl.types import Arrives, Decision, Intervention, Transition

N, V = 3, 4
KEY = jax.random.key(0)


class Singing(NamedTuple):
    choir: jax.Array
    clock: jax.Array


@dataclass(frozen=True)
class Choir(Environment):
    """Three agents of one of eight choirs: agent i has the number choir · 10^i + 1000 · clock.

    Episodes of even choirs end after four steps, the others after three. What an agent earns is its action.
    """

    num_agents: int = N
    num_actions: int = 7
    observation_size: int = 1
    max_cycles: int = 4
    deaf_to: tuple[int, ...] | None = None
    """Agents whom nobody hears, by the task's own graph; None: the task prescribes none."""

    def reset(self, key: Any, params: Any = ()) -> Any:
        state = Singing(jax.random.randint(key, (), 1, 9), jnp.zeros((), jnp.int32))
        return state, self.look(state)

    def step(self, state: Any, action: Any, key: Any, params: Any = ()) -> Any:
        state = state._replace(clock=state.clock + 1)
        over = state.clock >= 4 - state.choir % 2
        return state, TimeStep(self.look(state), action * 1.0, jnp.zeros((), bool), over)

    def look(self, state: Any) -> Any:
        numbers = state.choir * jnp.array([1.0, 10.0, 100.0]) + 1000.0 * state.clock
        graph = None
        if self.deaf_to is not None:
            graph = (~jnp.eye(N, dtype=bool)).at[:, jnp.asarray(self.deaf_to, int)].set(False)
        return observe(numbers[:, None], num_actions=7, adjacency=graph)


def sing(memory: Any, observation: Any, key: Any) -> Any:
    """Say your number; then twice your number and the sum of the numbers heard. Act by the sum of what is heard then."""
    number, hears = observation.features[:, 0], heard_adjacency(observation, 1.0)

    def said(first: Any) -> Any:
        return jnp.stack([first, 0 * first, 0 * first, jnp.ones(N)], axis=1)

    def heard(words: Any, number: int) -> Any:
        return (hears * arriving(words, observation.arrives, number, 2)[None, :, 0]).sum(1)

    one = said(number)
    sums = heard(one, 0)
    two = said(2 * number + sums)
    last = heard(two, 1)
    return Decision(last.astype(jnp.int32) % 7, jnp.stack([one, two]), hears, {"heard": (sums, last)}), memory


def sung(intervention: Intervention | None, num_envs: int, num_steps: int, env: Choir = Choir()) -> Transition:
    """Steps [T, E, …]."""

    @jax.jit
    def play() -> Any:
        carry = rollout.start(env, (), (), KEY, num_envs, intervention, sing)
        return rollout.collect(env, sing, (), (), carry, jax.random.key(1), num_steps, intervention)[1]

    return jax.tree.map(np.asarray, play().transitions)


def of(choirs: list[int], intervention: Intervention | None) -> tuple[np.ndarray, ...]:
    """What choirs of these numbers say in both rounds of their first step, and hear in both, each [E, N]."""

    @jax.jit
    def play() -> Any:
        carry = rollout.start(Choir(), (), (), KEY, len(choirs), intervention, sing)
        state = carry.env_state._replace(choir=jnp.asarray(choirs, jnp.int32))
        carry = carry._replace(env_state=state, observation=jax.vmap(Choir().look)(state))
        return rollout.step(Choir(), sing, (), (), carry, KEY, intervention)[1]

    decision = play().decision
    return (*np.moveaxis(np.asarray(decision.messages)[..., 0], 1, 0), *map(np.asarray, decision.extras["heard"]))


def numbers_of(steps: Transition) -> np.ndarray:
    """What is said in the first round [T, E, N], which no intervention touches."""
    return steps.observation.features[..., 0]


# Each by hand.


def test_the_choir_by_itself():
    one, two, first, second = of([1], None)
    np.testing.assert_array_equal(one, [[1, 10, 100]])
    np.testing.assert_array_equal(first, [[110, 101, 11]])
    np.testing.assert_array_equal(two, [[2 + 110, 20 + 101, 200 + 11]])
    np.testing.assert_array_equal(second, [[121 + 211, 112 + 211, 112 + 121]])


def test_swapped_agents_are_heard_with_each_others_words_in_every_round():
    """What agent 0 says in the second round depends on whom it heard as agent 2 in the first."""
    one, two, first, second = of([1], interventions.swap(0, 2))
    np.testing.assert_array_equal(one, [[1, 10, 100]])
    # Heard are 100, 10, 1: agent 0 hears agent 2 say 1, its own word.
    np.testing.assert_array_equal(first, [[10 + 1, 100 + 1, 100 + 10]])
    np.testing.assert_array_equal(two, [[2 + 11, 20 + 101, 200 + 110]])
    # Heard are 310, 121, 13. (One pass late they would be the swapped words of the choir by itself: 211, 121, 112.)
    np.testing.assert_array_equal(second, [[121 + 13, 310 + 13, 310 + 121]])


def test_scrambled_words_come_from_the_next_episode_in_every_round():
    one, two, first, second = of([1, 2, 3], interventions.scramble())
    np.testing.assert_array_equal(one, [[1, 10, 100], [2, 20, 200], [3, 30, 300]])
    # Choir 1 hears choir 3, choir 2 choir 1, and choir 3 choir 2.
    np.testing.assert_array_equal(first, [[330, 303, 33], [110, 101, 11], [220, 202, 22]])
    np.testing.assert_array_equal(two, [[332, 323, 233], [114, 141, 411], [226, 262, 622]])
    np.testing.assert_array_equal(second, [[262 + 622, 226 + 622, 226 + 262], [556, 565, 655], [552, 525, 255]])


def test_silenced_agents_are_not_heard():
    one, two, first, second = of([1], interventions.silence([1]))
    np.testing.assert_array_equal(one, [[1, 10, 100]])
    np.testing.assert_array_equal(first, [[100, 1 + 100, 1]])
    np.testing.assert_array_equal(two, [[2 + 100, 20 + 101, 200 + 1]])
    np.testing.assert_array_equal(second, [[201, 102 + 201, 102]])
    _, two, first, second = of([1], interventions.silence())
    np.testing.assert_array_equal(two, [[2, 20, 200]])
    assert not first.any() and not second.any()


@pytest.mark.parametrize("agents", [(0,), (2, 0), (0, 1, 2)])
def test_silence_is_a_graph_without_the_edges(agents: tuple[int, ...]):
    """The task prescribes the graph in which nobody hears these agents; everything is the same, in all of 9 steps."""
    silent = sung(interventions.silence(agents), 3, 9)
    deaf = sung(None, 3, 9, Choir(deaf_to=agents))
    jax.tree.map(np.testing.assert_array_equal, silent.decision, deaf.decision)
    np.testing.assert_array_equal(silent.reward, deaf.reward)
    hearing = ~np.eye(N, dtype=bool)
    hearing[:, agents] = False
    assert (silent.decision.adjacency == hearing).all()
    if len(agents) == N:
        jax.tree.map(np.testing.assert_array_equal, sung(interventions.silence(), 3, 9).decision, silent.decision)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_words_are_late_and_none_outlive_their_episode(steps: int):
    """In 20 steps of four choirs, whose episodes end apart: the words of `steps` before, of the same episode alone."""
    found = sung(interventions.delay(steps), 4, 20)
    number, said = numbers_of(found), found.decision.messages[..., 0]
    assert found.first.sum(0).min() > 3 and (found.first[:, 0] != found.first[:, 1]).any()
    nothing = 0
    for e in range(4):
        age = 0
        for t in range(20):
            age = 0 if found.first[t, e] else age + 1
            one, two = said[t - steps, e] if age >= steps else np.zeros((2, N))
            nothing += age < steps
            assert found.decision.adjacency[t, e].any() == (age >= steps)
            sums = one.sum() - one
            np.testing.assert_array_equal(found.decision.extras["heard"][0][t, e], sums)
            np.testing.assert_array_equal(said[t, e, 1], 2 * number[t, e] + sums)
            np.testing.assert_array_equal(found.decision.extras["heard"][1][t, e], two.sum() - two)
    assert nothing > 20 if steps > 1 else nothing > 10
    if steps == 3:
        assert nothing < 80, "and something is heard in the longer episodes"


def test_delayed_words_of_dial_are_heard_one_step_later_than_they_are_anyway():
    """A word of step t is in the inboxes after step t + 1, and heard at t + 2; in a new episode inboxes are empty."""
    env = Spread(N, 2, max_cycles=4)
    config = DialConfig(network=NetworkConfig(width=8, vocabulary=V, communication="dial", recurrent=True))
    algorithm = algorithms.make(config, env, TrainingConfig(env_steps=100, num_envs=2, num_steps=9))
    memory, params, learner = algorithm.initial_memory(N), env.default_params(), drawn_learner(algorithm)

    @jax.jit
    def play(learner: Any) -> Any:
        policy, late = algorithm.policy(learner, True), interventions.delay(1)
        carry = rollout.start(env, params, memory, KEY, 2, late, policy)
        return rollout.collect(env, policy, memory, params, carry, jax.random.key(1), 9, late)[1]

    steps = play(learner).transitions
    said, inbox = np.asarray(steps.decision.messages)[:, :, 0], np.asarray(steps.decision.extras["memory"].inbox)
    assert (said > 0).all()
    for t in range(9):
        age = t % 4
        np.testing.assert_array_equal(inbox[t], said[t - 2] if age >= 2 else np.zeros_like(said[t]))


# Chance.


def within(found: Any, expected: float, count: int, sigmas: float = 5.0) -> bool:
    """A share of so many trials is as far from its expectation as chance lets it be."""
    return bool(np.abs(found - expected).max() < sigmas * np.sqrt(expected * (1 - expected) / count))


@pytest.mark.parametrize("p", [0.2, 0.7])
def test_edges_are_dropped_one_by_one_anew_in_every_step(p: float):
    """Each with probability p, whatever becomes of other edges, other steps and other episodes."""
    steps = sung(interventions.drop(p), 60, 60)
    kept, number = steps.observation.arrives.kept, numbers_of(steps)
    edges = kept[:, :, ~np.eye(N, dtype=bool)].astype(float)  # [T, E, 6]
    assert within(edges.mean((0, 1)), 1 - p, 3_600)
    both = (1 - p) ** 2
    assert within((edges[1:] * edges[:-1]).mean((0, 1)), both, 59 * 60), "steps"
    assert within((edges[:, 1:] * edges[:, :-1]).mean((0, 1)), both, 60 * 59), "episodes"
    for one in range(6):
        for other in range(one):
            assert within((edges[..., one] * edges[..., other]).mean(), both, 3_600), "edges"
    # A lost edge loses all rounds of a step.
    hears = kept & ~np.eye(N, dtype=bool)
    np.testing.assert_array_equal(steps.decision.adjacency, hears)
    for number, of_round in enumerate(steps.decision.extras["heard"]):
        words = steps.decision.messages[:, :, number, :, 0]
        np.testing.assert_array_equal(of_round, np.einsum("teij,tej->tei", hears, words))


@pytest.mark.parametrize("p", [0.3, 1.0])
def test_words_are_replaced_by_symbols_that_are_drawn_uniformly(p: float):
    """Each word with probability p, for all who hear it; other words arrive as they were said."""
    steps = sung(interventions.noise(p), 60, 30)
    values, replaced, kept = steps.observation.arrives
    assert kept is None and replaced.shape == (30, 60, 2, N) and values.shape == (30, 60, 2, N, V)
    assert (np.sort(values, axis=-1) == [0, 0, 0, 1]).all()
    if p == 1.0:
        assert replaced.all()
    else:
        share = replaced.astype(float)
        assert within(share.mean((0, 1)), p, 1_800)
        assert within((share[:, :, 0] * share[:, :, 1]).mean((0, 1)), p * p, 1_800), "rounds"
        assert within((share[..., 1:] * share[..., :-1]).mean((0, 1)), p * p, 1_800), "agents"
        assert within((share[1:] * share[:-1]).mean((0, 1)), p * p, 29 * 60), "steps"
        assert within((share[:, 1:] * share[:, :-1]).mean((0, 1)), p * p, 30 * 59), "episodes"
    counts = values.sum((0, 1))  # of each round and agent
    assert ((counts - 450) ** 2 / 450).sum(-1).max() < 21.1, "the 0.9999 quantile at 3 degrees of freedom"
    counts = values[replaced].sum(0)
    assert ((counts - counts.mean()) ** 2 / counts.mean()).sum() < 21.1, "which is drawn does not say whether"
    for number, of_round in enumerate(steps.decision.extras["heard"]):
        said = steps.decision.messages[:, :, number, :, 0]
        arrived = np.where(replaced[:, :, number], values[:, :, number, :, 0], said)
        np.testing.assert_array_equal(of_round, arrived.sum(-1, keepdims=True) - arrived)


@pytest.mark.parametrize("text", ["drop 0", "noise 0", "swap 1 1"])
def test_what_changes_nothing_changes_nothing(text: str):
    jax.tree.map(
        np.testing.assert_array_equal, sung(interventions.parse(text), 3, 6).decision, sung(None, 3, 6).decision
    )


def test_everything_dropped_is_silence():
    dropped, silent = (sung(interventions.parse(text), 3, 6).decision for text in ("drop 1", "silence"))
    jax.tree.map(np.testing.assert_array_equal, dropped, silent)


# Everything that plays plays them.

EVERY = ("silence", "silence 0 2", "swap 0 1", "scramble", "drop 0.4", "delay 1", "delay 2", "noise 0.4")


@pytest.mark.parametrize("text", EVERY)
def test_an_episode_that_is_recorded_is_the_one_that_is_measured(text: str):
    """What the choir earns depends on what it hears."""
    arguments = (Choir(), sing, (), (), KEY, 5, interventions.parse(text))
    recorded = record_many(*arguments)
    measured = jax.jit(lambda: evaluate(*arguments))()["return_agent_mean"]
    np.testing.assert_allclose([episode.return_so_far[-1] for episode in recorded], measured, rtol=1e-6)
    plain = jax.jit(lambda: evaluate(*arguments[:-1]))()["return_agent_mean"]
    assert (measured != plain).any()


TALKING = {
    "mappo": MappoConfig(
        network=NetworkConfig(width=8, depth=1, communication="discrete", rounds=2, vocabulary=V)
    ),
    "mappo, commnet": MappoConfig(network=NetworkConfig(width=8, depth=1, communication="commnet", rounds=2)),
    "dial": DialConfig(network=NetworkConfig(width=8, vocabulary=V, communication="dial", recurrent=True)),
    "gacrl_paper": GacrlPaperConfig(batch_size=2, replay_capacity=10),
}


@pytest.mark.parametrize("name", TALKING)
@pytest.mark.parametrize("text", ["swap 0 2", "scramble"])
def test_what_arrives_is_what_others_say_in_this_very_step(name: str, text: str):
    """Of agents who draw their words: in every round the words that are said, and none that would have been."""
    env = Spread(N, 2, max_cycles=3)
    algorithm = algorithms.make(TALKING[name], env, TrainingConfig(env_steps=100, num_envs=3, num_steps=5))
    memory, params, intervention = algorithm.initial_memory(N), env.default_params(), interventions.parse(text)

    @jax.jit
    def play(learner: Any) -> Any:
        policy = algorithm.policy(learner, True)
        carry = rollout.start(env, params, memory, KEY, 3, intervention, policy)
        return rollout.collect(env, policy, memory, params, carry, jax.random.key(1), 5, intervention)[1]

    steps = play(drawn_learner(algorithm)).transitions
    said, arrives = np.asarray(steps.decision.messages), steps.observation.arrives
    others = np.roll(said, 1, axis=1) if text == "scramble" else said[..., [2, 1, 0], :]
    assert arrives.kept is None and arrives.replaced.all()
    np.testing.assert_allclose(arrives.values, others, atol=1e-6)
    assert np.abs(others - said).max() > 0.1


# What is refused.


@pytest.mark.parametrize(
    ("text", "stranger"), [("silence 3", 3), ("silence 0 -1", -1), ("swap 0 7", 7), ("swap 3 1", 3)]
)
def test_agents_that_there_are_not_are_refused_in_one_sentence(text: str, stranger: int):
    for play in (evaluate, record_many):
        with pytest.raises(ConfigError) as caught:
            play(Choir(), sing, (), (), KEY, 2, interventions.parse(text))
        sentence = f"{text.split()[0]}: there are the agents 0 to 2, and no agent {stranger}"
        assert re.fullmatch(sentence, str(caught.value))


def test_a_list_of_nobody_silences_nobody_and_is_refused():
    with pytest.raises(ConfigError, match="silence: name an agent, or give no list to silence all"):
        interventions.silence([])


def test_a_single_episode_cannot_be_scrambled():
    for play in (evaluate, record_many):
        with pytest.raises(ConfigError) as caught:
            play(Choir(), sing, (), (), KEY, 1, interventions.scramble())
        assert str(caught.value) == "to scramble messages takes at least two episodes side by side"


@pytest.mark.parametrize("text", EVERY)
def test_where_nobody_says_anything_there_is_nothing_to_intervene_in(text: str):
    policy, intervention = references.noop(Choir()).policy, interventions.parse(text)
    for play in (evaluate, record_many):
        with pytest.raises(ConfigError, match="the agents say nothing: there are no messages to"):
            play(Choir(), policy, (), (), KEY, 2, intervention)
    with pytest.raises(ConfigError, match="the agents say nothing: there are no messages to"):
        interventions.example(text, lambda: None)


@pytest.mark.parametrize("shape", [(2, N, V), (2, 1, N, V), (2, 2, N + 1, V), (2, 2, N, V - 1)])
def test_words_that_do_not_fit_are_refused_in_one_sentence(shape: tuple[int, ...]):
    wrong = Intervention("wrong", lambda *_: Arrives(jnp.zeros(shape)))
    sentence = f"what arrives must be [rounds, agents, symbols] = [2, 3, 4], not {list(shape[1:])}"
    with pytest.raises(ConfigError) as caught:
        evaluate(Choir(), sing, (), (), KEY, 2, wrong)
    assert str(caught.value) == sentence


# As text.


@pytest.mark.parametrize(
    ("text", "made"),
    [
        ("silence", interventions.silence()),
        ("silence 0 2", interventions.silence([0, 2])),
        ("  swap  0 2 ", interventions.swap(0, 2)),
        ("scramble", interventions.scramble()),
        ("drop 0.25", interventions.drop(0.25)),
        ("drop 1", interventions.drop(1.0)),
        ("delay 2", interventions.delay(2)),
        ("noise 1e-1", interventions.noise(0.1)),
    ],
)
def test_what_is_written_is_what_it_says(text: str, made: Intervention):
    parsed = interventions.parse(text)
    assert parsed is not None and parsed.name == made.name == text.split()[0]
    jax.tree.map(np.testing.assert_array_equal, sung(parsed, 3, 6), sung(made, 3, 6))


def test_nothing_is_written_for_nothing():
    assert interventions.parse("") is None and interventions.parse("  ") is None
    assert interventions.example("", lambda: pytest.fail("nobody asks")) == Arrives()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("silnce", r"unknown intervention 'silnce': did you mean 'silence'\?"),
        ("Silence", r"unknown intervention 'Silence': did you mean 'silence'\?"),
        ("0.2", r"unknown intervention '0\.2'"),
        ("silence me", r"'silence me' is no intervention: write it as `silence \[AGENT …\]`"),
        ("silence 0.5", r"'silence 0\.5' is no intervention: write it as `silence \[AGENT …\]`"),
        ("swap", r"'swap' is no intervention: write it as `swap AGENT AGENT`"),
        ("swap 0", r"'swap 0' is no intervention: write it as `swap AGENT AGENT`"),
        ("swap 0 1 2", r"'swap 0 1 2' is no intervention: write it as `swap AGENT AGENT`"),
        ("scramble 3", r"'scramble 3' is no intervention: write it as `scramble`"),
        ("drop", r"'drop' is no intervention: write it as `drop PROBABILITY`"),
        ("drop half", r"'drop half' is no intervention: write it as `drop PROBABILITY`"),
        ("drop 1.5", r"drop must be a probability between 0 and 1, not 1\.5"),
        ("drop nan", r"drop must be a probability between 0 and 1, not nan"),
        ("noise -0.1", r"noise must be a probability between 0 and 1, not -0\.1"),
        ("delay", r"'delay' is no intervention: write it as `delay STEPS`"),
        ("delay 1.5", r"'delay 1\.5' is no intervention: write it as `delay STEPS`"),
        ("delay 0", r"delay must be a whole number of steps between 1 and 1000, not 0"),
        ("delay 1001", r"delay must be a whole number of steps between 1 and 1000, not 1001"),
    ],
)
def test_anything_else_is_refused_in_one_sentence(text: str, said: str):
    with pytest.raises(ConfigError, match=f"^{said}") as caught:
        interventions.parse(text)
    assert "\n" not in str(caught.value)


def test_the_example_has_the_shapes_of_what_arrives():
    """Of one environment, as a learner's memory must hold it."""
    for text in EVERY:
        zeros = interventions.example(text, lambda: (2, N, V))
        found = sung(interventions.parse(text), 3, 1).observation.arrives
        shapes = jax.tree.map(lambda leaf: (leaf.shape[2:], leaf.dtype), found)
        assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), zeros) == shapes
        assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(zeros))
