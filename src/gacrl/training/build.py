"""Build what a run is made of, from its settings: the task, the algorithm, the trainer, and what it will take."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
from jax.sharding import Mesh

from gacrl import tasks
from gacrl.algorithms import build as build_algorithm
from gacrl.algorithms.contract import Algorithm
from gacrl.config.checks import require
from gacrl.config.run import RunConfig
from gacrl.envs.environment import Environment
from gacrl.envs.hosted import Hosted
from gacrl.errors import ConfigError
from gacrl.evaluation.references import look_of
from gacrl.messages import interventions
from gacrl.tasks.foreign.crew import Crew
from gacrl.tasks.task import Task
from gacrl.training import curriculum, footprint
from gacrl.training.curriculum import constant
from gacrl.training.devices import mesh_for
from gacrl.training.host_trainer import HostTrainer
from gacrl.training.recorder import SHOWN_EPISODES
from gacrl.training.trainer import AbstractTrainer, Trainer, TrainState
from gacrl.types import Intervention, Learner


@dataclass(frozen=True)
class Plan:
    """Tell what a run is going to be, before anything is allocated or compiled."""

    parameters: int
    """Numbers that a seed's network learns."""
    bytes_per_seed: int
    """Memory of a seed's training state (networks, optimiser, replay, environments)."""
    bytes_needed: int
    """Of all seeds, at the least: their states, the checkpoint being written, and what is worked on beside it; at the
    end, the episodes that are kept to look at. Seeds that take turns on a device have one state more there."""
    devices: tuple[str, ...]
    num_agents: int
    max_cycles: int
    """Steps of an episode."""
    notes: tuple[str, ...]
    """What is otherwise than the settings make one expect."""


def make_trainer(
    config: RunConfig,
    devices: Mesh | None = None,
    learns: bool = True,
    intervention: Intervention | None = None,
) -> AbstractTrainer:
    """Make the compiled functions that train this configuration; on these devices, of the axes `seeds` and `envs`.

    learns: False for policies that are only played: the task then does not move. intervention: what happens to their
    messages; by default what the settings say. Raises ConfigError for settings that do not fit each other.
    """
    task = tasks.find(config.task)
    env, algorithm = task.make(config.env), make_algorithm(config)
    over = config.training.env_processes if learns else 1
    params = task.numbers(config.env, env, getattr(config.algorithm, "gamma", 1.0))
    evaluated = evaluated_settings(config)
    evaluation_env = task.make(evaluated)
    if over > 1:
        crew = Crew(over)
        env, evaluation_env = (_over(crew, one, task) for one in (env, evaluation_env))
    kind = HostTrainer if env.hosted else Trainer
    return kind(
        algorithm=algorithm,
        env=env,
        params=params,
        curriculum=curriculum.make(config.curriculum, task, config.env, params) if learns else constant(),
        num_envs=config.training.num_envs,
        num_steps=config.training.num_steps,
        num_seeds=config.num_seeds,
        metrics=task.metrics,
        evaluation_env=evaluation_env,
        evaluation_params=task.numbers(evaluated, evaluation_env),
        mesh=mesh(config, algorithm) if devices is None else devices,
        for_speed=algorithm.compiled_for_speed,
        watched=tasks.brought(config.task) is not None and not env.hosted,  # the host looks itself
        look=look_of(task, evaluated),
        intervention=interventions.parse(config.training.intervention) if intervention is None else intervention,
    )


def _over(crew: Crew, env: Environment, task: Task) -> Hosted:
    """Return the same environment, over processes. Raises ConfigError for one that is compiled."""
    if not isinstance(env, Hosted):
        raise ConfigError(
            f"training.env_processes {crew.size} is for environments that live in Python, and {task.name} is compiled: "
            "leave it at 1"
        )
    return env.over(crew)


def make_algorithm(config: RunConfig) -> Algorithm:
    """Make the algorithm for the shapes of the task. Raises ConfigError for a task that it cannot play."""
    task = tasks.find(config.task)
    require(
        not (getattr(config.algorithm, "fixed_team", False) and task.ragged(config.env)),
        f"{config.algorithm.name} knows teams of one size only, and in {task.name} as it is set agents may be absent: "
        "take another preset",
    )
    return build_algorithm.make(config.algorithm, task.make(config.env), config.training, task.progress)


def mesh(config: RunConfig, algorithm: Algorithm | None = None) -> Mesh:
    """Return the devices that train this configuration: some algorithms learn from environments spread over several."""
    algorithm = make_algorithm(config) if algorithm is None else algorithm
    return mesh_for(config.num_seeds, config.training.num_envs if algorithm.splits_envs else None)


def evaluated_settings(config: RunConfig) -> Any:
    """Return the task as it is evaluated: with the evaluation's own horizon, where it has one."""
    task: Task = tasks.find(config.task)
    horizon = config.evaluation.horizon
    return config.env if horizon is None else task.with_horizon(config.env, horizon)


def plan(trainer: AbstractTrainer, config: RunConfig) -> Plan:
    """Count what a run needs, without allocating it. Raises UserError where this machine has not the memory."""
    member, devices = member_shapes(trainer), list(trainer.mesh.devices.flat)
    state, working = footprint.size(member), footprint.working_bytes(config, trainer.algorithm, member)
    look = look_of(tasks.find(config.task), evaluated_settings(config))
    env, params = trainer.evaluation_env, trainer.evaluation_params
    recorded = footprint.recording_bytes(env, params, SHOWN_EPISODES, look)
    places = trainer.mesh.shape["seeds"]
    turns = -(-config.num_seeds // places)
    states = state * turns * places
    working += state if turns > 1 and devices[0].platform == "cpu" else 0  # a state is taken out for its turn
    needed = max(states + state * config.num_seeds + working * len(devices), states + recorded)
    footprint.require_room(needed, devices[0])
    learned = jax.tree.leaves(trainer.algorithm.parameters(member.learner))
    return Plan(
        parameters=sum(leaf.size for leaf in learned),
        bytes_per_seed=state,
        bytes_needed=needed,
        devices=tuple(f"{device.platform}:{device.id}" for device in devices),
        num_agents=int(trainer.env.num_agents),
        max_cycles=int(trainer.env.max_cycles),
        notes=tuple(_notes(config)),
    )


def _notes(config: RunConfig) -> Iterator[str]:
    task, rule = tasks.find(config.task), getattr(config.algorithm, "exploration", None)
    if rule == "adaptive" and task.progress is None:
        yield (
            f"exploration falls linearly over {config.algorithm.exploration_steps:,} steps "
            f"(--algorithm.exploration-steps): {task.name} does not say what progress is"
        )


def member_shapes(trainer: AbstractTrainer) -> TrainState:
    """Return the shapes of a seed's training state."""
    return jax.eval_shape(lambda: trainer.init_member(jax.random.key(0), trainer.algorithm.hyper))


def stacked_shapes(trainer: AbstractTrainer, num_seeds: int | None = None) -> TrainState:
    """Return the shapes of the training state of all seeds, as a checkpoint holds it; or of so many."""
    return _stacked(member_shapes(trainer), trainer.num_seeds if num_seeds is None else num_seeds)


def learner_shapes(trainer: AbstractTrainer) -> Learner:
    """Return the shapes of the learners of all seeds.

    Environments, and what happens to messages in them, do not matter.
    """
    algorithm = trainer.algorithm
    return _stacked(jax.eval_shape(lambda: algorithm.init(jax.random.key(0), algorithm.hyper)), trainer.num_seeds)


def _stacked(shapes: Any, num_seeds: int) -> Any:
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((num_seeds, *leaf.shape), leaf.dtype), shapes)
