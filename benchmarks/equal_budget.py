"""Ours and BenchMARL's MAPPO and IPPO on simple_spread: the same networks, batches, epochs and steps; pace and score.

    python benchmarks/equal_budget.py [--steps 60000] [--seeds 3] [--benchmarl CHECKOUT] [--python PYTHON] [--out FILE]

Both train on MPE's simple_spread of 25 steps with five actions, theirs PettingZoo's, with BenchMARL's defaults: 256
wide, two layers, batches of 6,000 steps, 45 epochs of 15 minibatches, its learning rate, discount and clipping. The
sides take turns, each training a process of its own on one thread. Steps a second are by CPU time of that process,
without compilation. The score is of 320 greedy episodes: the mean return of an agent in MPE2's convention (random
-26.2, the scripted oracle -7.0), and the share of landmarks with an agent within 0.1 at the end.

--benchmarl: a checkout of its repository, whose source is run (its commit is told) in place of the installed package.
--python: an interpreter that has it; by default an environment that is made for the purpose. EPyMARL is left out:
docs/scaling.md says why.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import peers
import training

ALGORITHMS = ("mappo", "ippo")
EPISODES, STEPS = 320, 25
BATCH = 6_000
Score = dict[str, float]


def ours(algorithm: str, steps: int, seed: int) -> Score:
    """Our preset with BenchMARL's networks, batches and epochs."""
    from gacrl.training.devices import prepare_jax

    prepare_jax()
    import jax

    from gacrl.training import build

    run = training.settings(algorithm, "benchmarl")
    learner = replace(
        run.algorithm,
        learning_rate=5e-5,
        learning_rate_end=5e-5,
        gamma=0.99,
        gae_lambda=0.9,
        clip_eps=0.2,
        ent_coef=0.0,
    )
    run = replace(run, algorithm=learner, training=replace(run.training, env_steps=steps), seed=seed)
    trainer = build.make_trainer(run)
    state = trainer.init(run.seeds)
    chunk = trainer.compiled(state, 1)
    updates = steps // run.steps_per_update
    begun = time.process_time()
    state, _ = jax.block_until_ready(chunk(state, updates))
    taken = time.process_time() - begun
    metrics: Any = trainer.evaluate(state.learner, False, "report", EPISODES)
    return {
        "steps": updates * run.steps_per_update,
        "steps_per_second": updates * run.steps_per_update / taken,
        "return": float(metrics["return_agent_mean"].mean()),
        "coverage": float(metrics["coverage_final_0.1"].mean()),
    }


class Trained(peers.Callback):
    """Ends BenchMARL's training after so many steps, and scores its policy. (Here: it pickles its callbacks.)"""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps, self.begun, self.score = steps, 0.0, {}

    def on_setup(self) -> None:
        self.begun = time.process_time()

    def on_train_end(self, training_td: Any, group: str) -> None:
        if self.experiment.total_frames < self.steps:
            return
        pace = self.experiment.total_frames / (time.process_time() - self.begun)
        from solve_peers import play_benchmarl

        found = play_benchmarl(self.experiment.policy, group, EPISODES, STEPS)
        print(json.dumps({"steps": self.experiment.total_frames, "steps_per_second": pace, **found}), flush=True)
        raise peers.Enough


def benchmarl(algorithm: str, steps: int, seed: int) -> None:
    """BenchMARL on PettingZoo's simple_spread; it prints what it found."""
    import torch
    from benchmarl.environments import PettingZooTask

    torch.set_num_threads(1)
    task = PettingZooTask.SIMPLE_SPREAD.get_from_yaml()
    task.config["max_cycles"] = STEPS
    settings = {"on_policy_collected_frames_per_batch": BATCH, "prefer_continuous_actions": False}
    peers.benchmarl_run(task, algorithm, Trained(steps), seed, **settings)


def run(words: list[str], python: str, checkout: str | None) -> Score:
    """A side's training in a process of its own. Raises RuntimeError with what it said where it fails."""
    environment = {**os.environ, **peers.ONE_THREAD, "XLA_FLAGS": ""}
    if checkout is not None and words[0] == "benchmarl":
        environment["PYTHONPATH"] = checkout
    done = subprocess.run([python, __file__, "--part", *words], env=environment, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith('{"steps"')]
    if not lines:
        raise RuntimeError((done.stderr.strip() or "no reason given").splitlines()[-1])
    return json.loads(lines[-1])


def versions_of_theirs(python: str, checkout: str | None) -> dict[str, str]:
    """What theirs is."""
    program = (
        "import json, importlib.metadata as m; print(json.dumps({n: m.version(n) for n in "
        "('benchmarl', 'torchrl', 'torch', 'pettingzoo')}))"
    )
    found = json.loads(subprocess.run([python, "-c", program], capture_output=True, text=True, check=True).stdout)
    if checkout is not None:
        command = ["git", "-C", checkout, "rev-parse", "HEAD"]
        found["commit"] = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--benchmarl", help="a checkout of the BenchMARL repository")
    parser.add_argument("--python", help="an interpreter that has BenchMARL")
    parser.add_argument("--out", type=Path, help="a file for everything that was found")
    parser.add_argument("--part", nargs=4, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.part is not None:
        side, algorithm, steps, seed = asked.part
        if side == "ours":
            print(json.dumps(ours(algorithm, int(steps), int(seed))))
        else:
            benchmarl(algorithm, int(steps), int(seed))
        return
    python = asked.python or peers.python_of("benchmarl")
    if python is None:
        sys.exit("BenchMARL cannot be installed here")
    from gacrl.versions import versions

    found: dict[str, Any] = {
        "command": f"python benchmarks/equal_budget.py --steps {asked.steps} --seeds {asked.seeds}",
        "versions": versions(),
        "theirs": versions_of_theirs(python, asked.benchmarl),
    }
    print(found["theirs"], flush=True)
    for algorithm in ALGORITHMS:
        for seed in range(100, 100 + asked.seeds):
            for side, interpreter in (("ours", sys.executable), ("benchmarl", python)):
                try:
                    score = run([side, algorithm, str(asked.steps), str(seed)], interpreter, asked.benchmarl)
                except RuntimeError as reason:
                    print(f"{side} {algorithm} seed {seed} failed: {reason}", flush=True)
                    continue
                found.setdefault(algorithm, {}).setdefault(side, []).append({"seed": seed, **score})
                said = ", ".join(f"{name} {value:,.4g}" for name, value in score.items())
                print(f"{side} {algorithm} seed {seed}: {said}", flush=True)
        for side, scores in found.get(algorithm, {}).items():
            medians = {name: statistics.median(it[name] for it in scores) for name in scores[0] if name != "seed"}
            print(f"{side} {algorithm}, median: {medians}", flush=True)
    if asked.out is not None:
        asked.out.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
