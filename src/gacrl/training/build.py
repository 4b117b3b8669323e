"""What a run is made of, from its settings: the task, the algorithm, the trainer, and what it will take."""

from dataclasses import dataclass, replace

import jax
from jax.sharding import Mesh

from gacrl import tasks
from gacrl.algorithms import build as build_algorithm
from gacrl.config.algorithms import GacrlConfig, LearningConfig, PpoConfig
from gacrl.config.run import RunConfig
from gacrl.tasks.spread.environment import Spread
from gacrl.training import curriculum, footprint
from gacrl.training.devices import mesh_for
from gacrl.training.trainer import Trainer, TrainState


@dataclass(frozen=True)
class Plan:
    """What a run is going to be: known before anything is allocated or compiled."""

    parameters: int
    """Numbers that a seed's network learns."""
    bytes_per_seed: int
    """Memory of a seed's training state (networks, optimiser, replay, environments)."""
    bytes_needed: int
    """Of all seeds, at the least: their states, the checkpoint being written, and what is worked on beside it."""
    devices: tuple[str, ...]


def make_trainer(config: RunConfig, devices: Mesh | None = None) -> Trainer:
    """The compiled functions that train this configuration; on these devices, of the axes `seeds` and `envs`."""
    env = tasks.make(config.env)
    if config.env.reward == "potential" and isinstance(config.algorithm, LearningConfig):
        env = replace(env, initial_params=env.initial_params._replace(potential_discount=config.algorithm.gamma))
    if config.curriculum.num_agents_start is not None:
        env = env.padded()
    return Trainer(
        algorithm=build_algorithm.make(config.algorithm, env, config.training),
        env=env,
        curriculum=curriculum.make(config.curriculum),
        num_envs=config.training.num_envs,
        num_steps=config.training.num_steps,
        num_seeds=config.num_seeds,
        evaluation_env=evaluation_env(config),
        mesh=mesh(config) if devices is None else devices,
        # GACRL's program is as quick when it is quickly compiled, others' 3 to 10 % slower (docs/design.md).
        for_speed=not isinstance(config.algorithm, GacrlConfig),
    )


def mesh(config: RunConfig) -> Mesh:
    """The devices that train this configuration: PPO learns from environments that are spread over several."""
    return mesh_for(
        config.num_seeds, config.training.num_envs if isinstance(config.algorithm, PpoConfig) else None
    )


def evaluation_env(config: RunConfig) -> Spread:
    """The task as it is evaluated: with the evaluation's own horizon, where it has one."""
    env, horizon = tasks.make(config.env), config.evaluation.horizon
    return env if horizon is None else replace(env, max_cycles=horizon)


def plan(trainer: Trainer, config: RunConfig) -> Plan:
    """Count what a run needs, without allocating it. Raises UserError where this machine has not the memory."""
    member, devices = member_shapes(trainer), list(trainer.mesh.devices.flat)
    state, working = footprint.size(member), footprint.working_bytes(config, member)
    needed = 2 * state * config.num_seeds + working * len(devices)
    footprint.require_room(needed, devices[0])
    network = getattr(member.learner, "network", ())
    return Plan(
        parameters=sum(leaf.size for leaf in jax.tree.leaves(network)),
        bytes_per_seed=state,
        bytes_needed=needed,
        devices=tuple(f"{device.platform}:{device.id}" for device in devices),
    )


def member_shapes(trainer: Trainer) -> TrainState:
    """The shapes of a seed's training state."""
    return jax.eval_shape(lambda: trainer.init_member(jax.random.key(0), trainer.algorithm.hyper))


def stacked_shapes(trainer: Trainer) -> TrainState:
    """The shapes of the training state of all seeds, as a checkpoint holds it."""
    return jax.tree.map(
        lambda leaf: jax.ShapeDtypeStruct((trainer.num_seeds, *leaf.shape), leaf.dtype), member_shapes(trainer)
    )
