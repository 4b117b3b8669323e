"""Rules of exploration: their levels by hand, what they follow, and PPO that takes random actions among its own."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import drawn_learner

from gacrl.algorithms import distributions, exploration, ippo
from gacrl.algorithms.exploration import EXPLORING, GREEDY, UNSETTLED, Exploration, Follower, Level
from gacrl.algorithms.shared import taken
from gacrl.config.algorithms import IppoConfig, LearningConfig, NetworkConfig, VdnConfig
from gacrl.config.kinds import EXPLORATION, resolve
from gacrl.config.run import TrainingConfig
from gacrl.envs.probes import Probe
from gacrl.errors import ConfigError
from gacrl.types import Decision, Transition

LEVELS: dict[str, Any] = {"epsilon": 1.0, "epsilon_end": 0.1, "temperature": 2.0, "temperature_end": 0.5}
SETTINGS = LearningConfig(**LEVELS, exploration_steps=200, greedy_share=0.25)
MEASURE = "coverage_0.2"


def level(rule: Exploration, env_steps: int, state: Any = ()) -> Level:
    """As an update or a policy asks for it."""
    return jax.jit(rule.level)(state, jnp.asarray(env_steps))


def following(progress: float) -> Follower:
    return Follower(jnp.asarray(progress))


def steps_of(mode: Any, done: Any, progress: Any) -> Transition:
    """Steps [T, E] of episodes that are explored or greedy, some of which end, and what they have come to."""
    mode = jnp.asarray(mode)
    return Transition(
        observation=None,  # pyright: ignore[reportArgumentType] not looked at
        decision=Decision(jnp.zeros((*mode.shape, 1), int), extras={"mode": mode}),
        reward=jnp.zeros((*mode.shape, 1)),
        terminated=jnp.zeros(mode.shape, bool),
        truncated=jnp.asarray(done),
        first=jnp.zeros(mode.shape, bool),
        next_observation=None,  # pyright: ignore[reportArgumentType]
        info={MEASURE: jnp.asarray(progress)},
    )


FOUR_STEPS = steps_of([[GREEDY], [GREEDY], [EXPLORING], [GREEDY]], [[True], [False], [True], [True]], [[0.5]] * 4)


# Levels that time alone moves.


def test_the_names_are_those_of_the_rules():
    assert {name: resolve(entry) for name, entry in EXPLORATION.items()} == {
        "none": exploration.none,
        "linear": exploration.linear,
        "fixed": exploration.fixed,
        "adaptive": exploration.adaptive,
        "yoked": exploration.yoked,
    }


@pytest.mark.parametrize(
    ("env_steps", "expected"),
    [(0, (1.0, 2.0)), (50, (0.775, 1.625)), (100, (0.55, 1.25)), (200, (0.1, 0.5)), (9_000, (0.1, 0.5))],
)
def test_linear_levels_fall_to_their_end_and_stay(env_steps: int, expected: tuple[float, float]):
    """Over 200 steps: ε by 0.0045 and τ by 0.0075 a step. How long the run is makes no difference."""
    for planned in (100, 10_000):
        rule = exploration.linear(SETTINGS, planned, MEASURE)
        assert rule.moves
        np.testing.assert_allclose(level(rule, env_steps), expected, rtol=1e-6)


def test_a_rise_is_as_linear_and_no_steps_are_the_end_at_once():
    rising = exploration.linear(LearningConfig(epsilon=0.2, epsilon_end=0.6, exploration_steps=4), 9, None)
    found = [float(level(rising, env_steps).epsilon) for env_steps in range(6)]
    np.testing.assert_allclose(found, [0.2, 0.3, 0.4, 0.5, 0.6, 0.6], rtol=1e-6)
    sudden = exploration.linear(LearningConfig(**LEVELS, exploration_steps=0), 9, None)
    np.testing.assert_allclose(level(sudden, 0), (1.0, 2.0))
    np.testing.assert_allclose(level(sudden, 1), (0.1, 0.5), rtol=1e-6)


@pytest.mark.parametrize(("name", "expected"), [("none", (0.0, 2.0)), ("fixed", (0.1, 0.5))])
def test_rules_that_stand_still(name: str, expected: tuple[float, float]):
    """Without random actions messages are as soft as at the start."""
    rule = resolve(EXPLORATION[name])(SETTINGS, 1_000, MEASURE)
    assert not rule.moves
    for env_steps in (0, 7, 10**6):
        np.testing.assert_allclose(level(rule, env_steps), expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["none", "linear", "fixed"])
def test_in_time_episodes_are_all_alike(name: str):
    rule = resolve(EXPLORATION[name])(SETTINGS, 1_000, MEASURE)
    assert (rule.init(), rule.initial_memory) == ((), ())
    assert rule.begin((), jax.random.key(0), 0.3) == ((), 0.3)
    assert rule.follow((), FOUR_STEPS) == ()


# Levels that follow progress.


def test_exploration_follows_what_greedy_episodes_cover():
    """end + (start − end) (1 − c)²: at c = 0.5, 0.1 + 0.9 / 4 and 0.5 + 1.5 / 4. Time makes no difference."""
    rule = exploration.adaptive(SETTINGS, 300, MEASURE)
    assert rule.moves
    for env_steps in (0, 9_000):
        for c, expected in ((0.0, (1.0, 2.0)), (0.5, (0.325, 0.875)), (0.8, (0.136, 0.56)), (1.0, (0.1, 0.5))):
            np.testing.assert_allclose(level(rule, env_steps, following(c)), expected, rtol=1e-6)
    np.testing.assert_array_equal(rule.init().progress, 0.0)

    # Two of the three environments end; only the first played greedily. An episode weighs a twentieth.
    steps = steps_of([[GREEDY, EXPLORING, GREEDY]], [[True, True, False]], [[0.8, 0.2, 0.4]])
    np.testing.assert_allclose(rule.follow(following(0.2), steps).progress, 0.2 + 0.05 * 0.6, rtol=1e-6)
    # Two that end in one rollout weigh as two that follow each other: 1 − 0.95², around their mean 0.6.
    steps = steps_of(
        [[GREEDY, EXPLORING], [GREEDY, GREEDY]], [[True, True], [False, True]], [[0.8, 0.1], [0.9, 0.4]]
    )
    np.testing.assert_allclose(rule.follow(following(0.2), steps).progress, 0.2 + 0.0975 * 0.4, rtol=1e-6)
    # The end of a task is an end as well as its time limit.
    over = steps._replace(terminated=steps.truncated, truncated=steps.terminated)
    np.testing.assert_allclose(rule.follow(following(0.2), over).progress, 0.2 + 0.0975 * 0.4, rtol=1e-6)
    # Nothing ends that was played greedily.
    steps = steps_of([[GREEDY, EXPLORING]], [[False, True]], [[0.9, 0.9]])
    assert rule.follow(following(0.2), steps).progress == jnp.float32(0.2)


def test_without_a_measure_of_progress_exploration_falls_in_time():
    """As the linear rule, and no episode is greedy for it."""
    rule, linear = (make(SETTINGS, 300, None) for make in (exploration.adaptive, exploration.linear))
    for env_steps, expected in ((0, (1.0, 2.0)), (50, (0.775, 1.625)), (200, (0.1, 0.5)), (999, (0.1, 0.5))):
        np.testing.assert_allclose(level(rule, env_steps, rule.init()), expected, rtol=1e-6)
        np.testing.assert_array_equal(level(rule, env_steps), level(linear, env_steps))
    assert (rule.init(), rule.initial_memory, rule.moves) == ((), (), True)
    assert rule.begin((), jax.random.key(0), 0.3) == ((), 0.3)


def yoked(progress: tuple[float, ...], planned_steps: int, measure: str | None = MEASURE) -> Exploration:
    settings = LearningConfig(**LEVELS, greedy_share=0.25, exploration="yoked", yoked_progress=progress)
    return exploration.yoked(settings, planned_steps, measure)


def test_a_yoked_level_replays_another_progress():
    rule, learned_well = yoked((0.0, 0.5, 1.0), 300), following(0.9)
    for steps, expected in (
        (0, (1.0, 2.0)),
        (99, (1.0, 2.0)),
        (100, (0.325, 0.875)),
        (299, (0.1, 0.5)),
        (900, (0.1, 0.5)),
    ):
        np.testing.assert_allclose(level(rule, steps, learned_well), expected, rtol=1e-6)
    # Where the steps cannot be shared out evenly, the last stretch is the shorter one: 34, 34 and 32 steps.
    uneven = yoked((0.0, 0.5, 1.0), 100)
    found = [float(level(uneven, steps, learned_well).epsilon) for steps in (33, 34, 67, 68, 99)]
    np.testing.assert_allclose(found, [1.0, 0.325, 0.325, 0.1, 0.1], rtol=1e-6)


def test_a_yoked_training_watches_its_own_progress_where_there_is_one():
    """So that nothing but the level differs; a task without a measure can be yoked as well."""
    after = yoked((0.5,), 300).follow(following(0.2), FOUR_STEPS)  # two greedy episodes, of 0.5 each
    np.testing.assert_allclose(after.progress, 0.2 + 0.0975 * 0.3, rtol=1e-6)
    unmeasured = yoked((0.5,), 300, None)
    assert unmeasured.follow(following(0.2), FOUR_STEPS._replace(info={})).progress == jnp.float32(0.2)
    np.testing.assert_allclose(level(unmeasured, 0, following(0.2)), (0.325, 0.875), rtol=1e-6)


def test_there_must_be_something_to_follow():
    with pytest.raises(ConfigError, match=r"yoked needs the progress to follow, in algorithm\.yoked_progress"):
        yoked((), 300)


def test_settings_that_no_rule_can_follow_are_refused():
    with pytest.raises(ConfigError, match=r"unknown algorithm\.exploration 'linaer': did you mean 'linear'"):
        LearningConfig(exploration="linaer")
    with pytest.raises(ConfigError, match="yoked_progress must be shares between 0 and 1"):
        LearningConfig(yoked_progress=(0.5, 1.5))
    for name, wrong in (("epsilon", 1.5), ("epsilon_end", -0.1), ("greedy_share", 2.0), ("temperature", 0.0)):
        with pytest.raises(ConfigError, match=rf"algorithm\.{name} must be between"):
            LearningConfig(**{name: wrong})


@pytest.mark.parametrize("rule", [exploration.adaptive(SETTINGS, 300, MEASURE), yoked((0.5,), 300)])
def test_an_episode_is_settled_once(rule: Exploration):
    keys = jax.random.split(jax.random.key(0), 4_000)
    assert int(rule.initial_memory) == UNSETTLED
    modes, epsilons = jax.vmap(lambda key: rule.begin(jnp.asarray(UNSETTLED), key, jnp.asarray(0.6)))(keys)
    assert abs((modes == GREEDY).mean() - 0.25) < 0.03
    assert set(np.unique(modes)) == {EXPLORING, GREEDY}
    np.testing.assert_allclose(epsilons, jnp.where(modes == GREEDY, 0.0, 0.6))
    again, levels = jax.vmap(lambda key, mode: rule.begin(mode, key, jnp.asarray(0.3)))(keys[::-1], modes)
    np.testing.assert_array_equal(again, modes)
    np.testing.assert_allclose(levels, jnp.where(modes == GREEDY, 0.0, 0.3))


# PPO with a rule.


def test_the_mixture_by_hand():
    """(1 − ε) π + ε / 3 for the three actions that are available. At ε = 0.3: 0.7 π + 0.1."""
    log_pi = jnp.log(jnp.array([[0.5, 0.25, 0.0, 0.25], [0.125, 0.0, 0.75, 0.125]]))
    mixed = np.exp(distributions.mixed(log_pi, jnp.array([0.3, 0.3])))
    np.testing.assert_allclose(mixed, [[0.45, 0.275, 0, 0.275], [0.1875, 0, 0.625, 0.1875]], rtol=1e-6)
    # An ε for each environment, of two agents each: 0, which is π, ½, and 1, which is uniform.
    log_pi = jnp.broadcast_to(log_pi, (3, 2, 4))
    mixed = np.exp(distributions.mixed(log_pi, jnp.array([[0.0], [0.5], [1.0]])))
    np.testing.assert_allclose(mixed[0], np.exp(log_pi[0]), rtol=1e-6)
    third = 1 / 3
    half = [[0.25 + third / 2, 0.125 + third / 2, 0, 0.125 + third / 2]]
    half += [[0.0625 + third / 2, 0, 0.375 + third / 2, 0.0625 + third / 2]]
    np.testing.assert_allclose(mixed[1], half, rtol=1e-6)
    np.testing.assert_allclose(mixed[2], [[third, third, 0, third], [third, 0, third, third]], rtol=1e-6)
    np.testing.assert_allclose(mixed.sum(-1), 1.0, rtol=1e-6)


@pytest.mark.parametrize("epsilon", [None, 0.0])
def test_without_random_actions_the_policy_is_handed_through(epsilon: float | None):
    log_pi = jnp.log(jnp.array([[0.5, 0.5, 0.0]]))
    assert distributions.mixed(log_pi, epsilon) is log_pi


@pytest.mark.parametrize("epsilon", [0.3, jnp.float32(0.3)], ids=["number", "array"])
def test_one_share_of_random_actions_is_that_of_all_agents(epsilon: Any):
    """As a rule hands it out for an environment."""
    log_pi = jnp.log(jnp.array([[0.5, 0.25, 0.0, 0.25], [0.125, 0.0, 0.75, 0.125]]))
    mixed = np.exp(distributions.mixed(log_pi, epsilon))
    np.testing.assert_allclose(mixed, [[0.45, 0.275, 0, 0.275], [0.1875, 0, 0.625, 0.1875]], rtol=1e-6)


def test_the_mixture_has_a_gradient_where_actions_are_missing():
    """d log(0.7 π₀ + 0.1) / d logit₀ = 0.7 π₀ (1 − π₀) / (0.7 π₀ + 0.1); nothing by what is not available."""
    mask = jnp.array([True, False, True, True])

    def log_first(logits: jax.Array) -> jax.Array:
        mixture = distributions.mixed(distributions.log_policy(logits, mask)[None], jnp.array([0.3]))
        return taken(mixture, jnp.array([0]))[0]

    logits = jnp.log(jnp.array([0.5, 0.9, 0.25, 0.25]))
    slope = jax.grad(log_first)(logits)
    expected = 0.7 * 0.5 * np.array([0.5, 0.0, -0.25, -0.25]) / 0.45
    np.testing.assert_allclose(slope, expected, rtol=1e-5, atol=1e-7)


FEW = Probe(num_actions=4)
"""A policy that is the same everywhere: (0.5, 0.25, 0.125, 0.125), by the biases of a head without weights."""
PI = np.array([0.5, 0.25, 0.125, 0.125])


def constant_policy(learner: Any) -> Any:
    where = lambda learner: (learner.network.actor.head.weight, learner.network.actor.head.bias)  # noqa: E731
    weight = learner.network.actor.head.weight
    return eqx.tree_at(where, learner, (jnp.zeros_like(weight), jnp.log(jnp.asarray(PI, jnp.float32))))


@pytest.mark.parametrize(
    ("rule", "updates", "expected"),
    [
        ("none", 2, PI),
        ("linear", 2, 0.4 * PI + 0.6 * 0.25),  # 2 · 16 of 64 steps: ε from 0.8 half of the way to 0.4
        ("linear", 9, 0.6 * PI + 0.4 * 0.25),
        ("fixed", 2, 0.6 * PI + 0.4 * 0.25),
        # c = 0.5: ε = 0.4 + 0.4 / 4; of a quarter of the episodes 0.
        ("adaptive", 2, 0.25 * PI + 0.75 * (0.5 * PI + 0.5 * 0.25)),
    ],
)
def test_ppo_acts_by_the_mixture_and_says_how_likely_that_was(rule: str, updates: int, expected: np.ndarray):
    """Actions are as frequent as the mixture says; greedily there are no random ones."""
    config = IppoConfig(
        network=NetworkConfig(width=4, depth=1),
        exploration=rule,
        epsilon=0.8,
        epsilon_end=0.4,
        exploration_steps=64,
        greedy_share=0.25,
    )
    algorithm = ippo.make(config, FEW, TrainingConfig(env_steps=1_000, num_envs=4, num_steps=4), MEASURE)
    learner = constant_policy(drawn_learner(algorithm))._replace(updates=jnp.int32(updates))
    if rule == "adaptive":
        learner = learner._replace(exploration=following(0.5))
    memory = algorithm.initial_memory(2)
    _, seen = FEW.reset(jax.random.key(0))
    act = jax.jit(
        lambda keys, explore: jax.vmap(lambda key: algorithm.policy(learner, explore)(memory, seen, key)[0])(keys),
        static_argnums=1,
    )
    keys = jax.random.split(jax.random.key(1), 8_000)
    decisions = act(keys, True)
    action = np.asarray(decisions.action)
    for agent in range(2):
        counts = np.bincount(action[:, agent], minlength=4)
        chi_square = (np.square(counts - expected * len(keys)) / (expected * len(keys))).sum()
        assert chi_square < 21.1, "the 0.9999 quantile at 3 degrees of freedom"
    likely = np.exp(np.asarray(decisions.extras["log_prob"]))
    if rule == "adaptive":
        greedy = np.asarray(decisions.extras["mode"] == GREEDY)
        assert abs(greedy.mean() - 0.25) < 0.03
        each = np.where(greedy[:, None], PI, 0.5 * PI + 0.5 * 0.25)[np.arange(len(keys))[:, None], action]
    else:
        each = expected[action]
    np.testing.assert_allclose(likely, each, rtol=1e-5)
    np.testing.assert_array_equal(act(keys[:50], False).action, 0)


def test_values_are_explored_and_policies_are_not_unless_it_is_said():
    assert VdnConfig().exploration == "linear"
    assert IppoConfig().exploration == "none"
