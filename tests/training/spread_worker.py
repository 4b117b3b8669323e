"""Ten updates by several devices or processes: `spread_worker.py NAMES OUT DEVICES [HOST:PORT COUNT PROCESS]`.

Its own program, since a process has its devices for life. Process 0 writes the training states.
"""

import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from gacrl.algorithms.shared import ENVS
from gacrl.config.presets import preset
from gacrl.config.run import RunConfig, TrainingConfig
from gacrl.training import build, distributed
from gacrl.training.devices import gathered, leads, without_padding
from gacrl.training.trainer import Trainer
from gacrl.training.watching import Watcher

UPDATES = 10


def configs(seeds: int) -> dict[str, RunConfig]:
    """PPO, whose environments are spread, and two learners whose seeds are: the paper's and the default one."""
    ippo, paper, gacrl = preset("ippo"), preset("paper"), preset("gacrl")
    return {
        "ippo": replace(
            ippo,
            algorithm=replace(ippo.algorithm, update_epochs=2, num_minibatches=2),
            training=TrainingConfig(env_steps=400, num_envs=8, num_steps=5),
            num_seeds=max(seeds // 4, 1),
        ),
        "paper": replace(
            paper,
            env=replace(paper.env, max_cycles=15),
            algorithm=replace(paper.algorithm, replay_capacity=500),
            num_seeds=seeds,
        ),
        "gacrl": replace(
            gacrl,
            algorithm=replace(gacrl.algorithm, replay_capacity=200, learning_starts=20, batch_size=8, updates=2),
            training=TrainingConfig(env_steps=200, num_envs=4, num_steps=5),
            num_seeds=seeds,
        ),
    }


def after_ten_updates(trainer: Trainer, config: RunConfig) -> dict[str, np.ndarray]:
    """Every number of the training state."""
    state, _ = jax.block_until_ready(trainer.chunk(trainer.init(config.seeds), UPDATES))
    whole = gathered(state)
    assert without_padding(whole.updates, config.num_seeds).tolist() == [UPDATES] * config.num_seeds
    leaves = jax.tree_util.tree_leaves_with_path(whole)
    return {jax.tree_util.keystr(path): _plain(leaf)[: config.num_seeds] for path, leaf in leaves}


def _plain(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def main(names: str, out: str, devices: str, where: str = "", count: str = "1", process: str = "0") -> None:
    jax.config.update("jax_num_cpu_devices", int(devices))
    place = distributed.find_place(where, int(count), int(process)) if where else distributed.ALONE
    seeds = int(devices) * place.count
    with distributed.joined(place, "", 120.0, Watcher()):
        for name in names.split(","):
            config = configs(seeds)[name]
            mesh = None
            if name == "ippo" and place.count == 1:  # of itself, one process does not spread environments on a CPU
                mesh = Mesh(np.asarray(jax.devices()).reshape(config.num_seeds, -1), ("seeds", ENVS))
            trainer = build.make_trainer(config, mesh)
            found = after_ten_updates(trainer, config)
            if leads():
                np.savez(f"{out}/{name}.npz", **found)


if __name__ == "__main__":
    main(*sys.argv[1:])
