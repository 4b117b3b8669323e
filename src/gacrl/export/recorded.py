"""Decisions of the run itself, for an exported program to repeat."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from gacrl.errors import UserError
from gacrl.evaluation.evaluate import stream_key
from gacrl.export.program import OUTPUTS, Program
from gacrl.export.source import Source
from gacrl.networks.memory import restarted

DECISIONS = 1000
_STRAYS = 0.01
"""Share of decisions in which rounding may choose the other one of two actions or symbols that are equally good."""

Arrays = dict[str, np.ndarray]


class Recorded(NamedTuple):
    """What the agents saw and remembered, and what they did and said, [K, …] by name."""

    inputs: Arrays
    outputs: Arrays


def record(source: Source, program: Program, count: int = DECISIONS) -> Recorded:
    """Play whole episodes side by side with the policy, as `gacrl evaluate` does, and keep `count` of its decisions."""
    run = source.opened
    env, params, fresh = run.env, run.trainer.evaluation_params, run.trainer.memory
    policy, steps = run.policy(0, False), run.env.max_cycles

    def step(carry: Any, key: Any) -> Any:
        state, seen, memory = carry
        decision, after = policy(memory, seen, key)
        shown = {"features": seen.features, "alive": seen.agent_mask, **_numbered(memory)}
        done = {name: getattr(decision, name) for name in OUTPUTS} | _numbered(after, "_next")
        state, told = env.step(state, decision.action, key, params)
        after = after if told.left is None else restarted(fresh, after, told.left)
        return (state, told.observation, after), (shown, done)

    def play(key: Any) -> Any:
        state, seen = env.reset(key, params)
        return jax.lax.scan(step, (state, seen, fresh), jax.random.split(key, steps))[1]

    keys = jax.random.split(stream_key("report"), -(-count // steps))
    shown, done = jax.device_get(jax.jit(jax.vmap(play))(keys))

    def kept(found: Arrays, names: Mapping[str, Any]) -> Arrays:
        return {name: np.reshape(found[name], (-1, *np.shape(found[name])[2:]))[:count] for name in names}

    return Recorded(kept(shown, program.inputs), kept(done, program.outputs))


def _numbered(memory: Any, behind: str = "") -> dict[str, Any]:
    return {f"memory_{number}{behind}": leaf for number, leaf in enumerate(jax.tree.leaves(memory))}


def compared(source: Source, program: Program, run: Callable[[Arrays], Arrays], count: int = DECISIONS) -> str:
    """Let an exported program repeat recorded decisions one by one, and return in a sentence how many it does.

    run: inputs by name -> outputs by name. Raises UserError where it decides otherwise in more than one of a hundred.
    """
    recorded = record(source, program, count)
    agree, largest = np.zeros(count, bool), 0.0
    for number in range(count):
        found = run({name: array[number] for name, array in recorded.inputs.items()})
        wanted = {name: array[number] for name, array in recorded.outputs.items()}
        agree[number] = all(np.allclose(found[name], wanted[name], atol=1e-4) for name in wanted)
        floats = [name for name in wanted if wanted[name].dtype.kind == "f"]
        if agree[number] and floats:
            largest = max(largest, *(float(np.abs(found[name] - wanted[name]).max()) for name in floats))
    if agree.mean() < 1 - _STRAYS:
        raise UserError(
            f"the exported policy of {source.name} decides otherwise than the run in {(~agree).sum()} of {count} "
            "decisions: take safetensors or npz"
        )
    return (
        f"It repeats {agree.sum():,} of {count:,} recorded decisions, messages and memory included; numbers differ by "
        f"{largest:.1e} at most."
    )
