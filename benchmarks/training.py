"""Training steps a second, beside JaxMARL and BenchMARL.

    python benchmarks/training.py [--rounds 3] [--core 0] [--jaxmarl CHECKOUT] [--only jaxmarl] [--json]

A step is one environment step, with its share of the updates; compilation is not part of it. Three comparisons:

* `jaxmarl`: IPPO and QMIX at JaxMARL's own networks, batches and epochs (its `ippo_ff_mpe.yaml` and
  `ql_rnn_mpe.yaml`). Its algorithms are not in its package: --jaxmarl names a checkout of the repository, whose
  `baselines` are run with the installed `jaxmarl`. Without one, ours is measured alone. Its QMIX does not learn in
  the first tenth of the 100,000 steps of a measurement, ours learns in all.
* `benchmarl as shipped`: BenchMARL's IPPO, MAPPO and QMIX on VMAS's simple_spread, defaults, against our presets.
* `benchmarl at its shapes`: its IPPO and MAPPO against ours with its networks, batches and epochs.

Ours has ReLU where the two have tanh.
"""

import argparse
import functools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import peers

SECONDS = 3.0
"""Of a measurement of ours, about."""
ITERATIONS = 1
"""Of a measurement of BenchMARL: of 6,000 steps each, with the training that follows."""


def settings(preset: str, shapes: str) -> Any:
    """One of our presets as it is, or with a peer's networks, batches and epochs."""
    from gacrl.config import presets

    run = presets.preset(preset)
    if shapes == "shipped":
        return run
    network = run.algorithm.network
    if preset == "qmix":
        learner = replace(run.algorithm, network=replace(network, width=64, depth=1, recurrent=True))
        learner = replace(learner, batch_size=32, sequence_length=26, n_step=1, updates=1, replay_capacity=130_000)
        return replace(run, algorithm=learner, training=replace(run.training, num_envs=8, num_steps=26))
    width, epochs, minibatches, num_envs, num_steps = {
        "jaxmarl": (64, 4, 4, 16, 128),
        "benchmarl": (256, 45, 15, 10, 600),
    }[shapes]
    learner = replace(run.algorithm, network=replace(network, width=width, depth=2))
    learner = replace(learner, update_epochs=epochs, num_minibatches=minibatches)
    return replace(run, algorithm=learner, training=replace(run.training, num_envs=num_envs, num_steps=num_steps))


@functools.cache
def ours(algorithm: str, shapes: str) -> Callable[[], float]:
    """Steps a second of a chunk of training."""
    from gacrl.training import build
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    import jax

    run = settings(algorithm, shapes)
    trainer = build.make_trainer(run)
    warm = -(-getattr(run.algorithm, "learning_starts", 0) // run.steps_per_update) + 1
    state, _ = trainer.chunk(trainer.init((0,)), warm)

    def chunk(updates: int) -> float:
        nonlocal state
        begun = time.process_time()
        state, report = trainer.chunk(state, updates)
        jax.block_until_ready(report)
        return (time.process_time() - begun) / (updates * run.steps_per_update)

    updates = max(1, round(SECONDS / (chunk(1) * run.steps_per_update)))
    return lambda: 1.0 / chunk(updates)


@functools.cache
def jaxmarl(algorithm: str, checkout: str) -> Callable[[], float]:
    """Steps a second of a whole short run of a baseline, compiled before."""
    import jax

    _, said, train = peers.jaxmarl_baseline(algorithm, checkout, 100_000)
    steps = said["NUM_UPDATES"] * said["NUM_STEPS"] * said["NUM_ENVS"]
    compiled = jax.jit(train).lower(jax.random.PRNGKey(0)).compile()

    def measure() -> float:
        begun = time.process_time()
        jax.block_until_ready(compiled(jax.random.PRNGKey(0)))
        return steps / (time.process_time() - begun)

    return measure


class Clock(peers.Callback):
    """When each of BenchMARL's iterations had collected its steps. (Here, because it pickles its callbacks.)"""

    def __init__(self) -> None:
        super().__init__()
        self.times: list[float] = []
        self.frames: list[int] = []

    def on_batch_collected(self, batch: Any) -> None:
        self.times.append(time.process_time())
        self.frames.append(batch.numel())
        if len(self.times) == ITERATIONS + 1:
            raise peers.Enough


def benchmarl(algorithm: str) -> float:
    """Steps a second between two of BenchMARL's iterations: one collection and one training."""
    import torch
    from benchmarl.environments import VmasTask

    torch.set_num_threads(1)
    clock = Clock()
    settings = {
        "max_n_iters": ITERATIONS + 1,
        "max_n_frames": None,
        "prefer_continuous_actions": algorithm != "qmix",
    }
    peers.benchmarl_run(VmasTask.SIMPLE_SPREAD.get_from_yaml(), algorithm, clock, seed=0, **settings)
    return sum(clock.frames[1:]) / (clock.times[-1] - clock.times[0])


def compare(rounds: int, core: int, checkout: str | None, only: str | None) -> dict[str, dict[str, list[float]]]:
    """How many times as fast as each peer, per algorithm and round."""
    us = peers.Side("ours", sys.executable, __file__, core)
    ratios: dict[str, dict[str, list[float]]] = {}

    def against(name: str, peer: peers.Side | None, shapes: str, algorithm: str, **request: str) -> bool:
        for turn in range(rounds):
            mine = us.ask(algorithm=algorithm, shapes=shapes)
            theirs = peer.ask(algorithm=algorithm, **request) if peer else None
            if mine is None or (peer and theirs is None):
                return False
            said = f"{name}, {algorithm}, round {turn + 1}: ours {mine:,.0f} steps/s"
            if theirs is not None:
                ratios.setdefault(name, {}).setdefault(algorithm, []).append(mine / theirs)
                said += f", theirs {theirs:,.0f}: {mine / theirs:.2f} times"
            print(said, flush=True)
        return True

    peer = None
    if only == "benchmarl":
        pass
    elif checkout is None:
        print("no checkout of JaxMARL (--jaxmarl): ours alone, at its shapes", flush=True)
    elif python := peers.python_of("jaxmarl"):
        peer = peers.Side("jaxmarl", python, __file__, core)
    for algorithm in ("ippo", "qmix") if only != "benchmarl" else ():
        if not against("jaxmarl", peer, "jaxmarl", algorithm, checkout=checkout or "") and peer:
            peer.close()
            peer = peers.Side("jaxmarl", peers.python_of("jaxmarl") or "", __file__, core)
    if peer:
        peer.close()
    python = peers.python_of("benchmarl") if only != "jaxmarl" else None
    for shapes, name, algorithms in (
        ("shipped", "benchmarl as shipped", ("ippo", "mappo", "qmix")),
        ("benchmarl", "benchmarl at its shapes", ("ippo", "mappo")),
    ):
        for algorithm in algorithms if python else ():
            peer = peers.Side("benchmarl", python or "", __file__, core)
            against(name, peer, shapes, algorithm)
            peer.close()
    us.close()
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3, help="turns of each side")
    parser.add_argument("--core", type=int, default=0, help="the core that all sides are pinned to")
    parser.add_argument("--jaxmarl", help="a checkout of the JaxMARL repository, for its baselines")
    parser.add_argument("--only", choices=("jaxmarl", "benchmarl"), help="one peer alone")
    parser.add_argument(
        "--json", action="store_true", help="end with one line: {ratio: {peer: {algorithm: value}}}"
    )
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        side = {"ours": ours, "jaxmarl": jaxmarl}.get(asked.serve)
        peers.serve((lambda **request: side(**request)()) if side else benchmarl)
        return
    ratios = compare(asked.rounds, asked.core, asked.jaxmarl, asked.only)
    for name, found in ratios.items():
        for algorithm, values in found.items():
            print(f"{algorithm}: {peers.spread(values)} times as fast as {name}")
    if asked.json:
        print(json.dumps(peers.summary(ratios)))


if __name__ == "__main__":
    main()
