"""The greedy policy of a run as one function of arrays, and which numbers it reads."""

import re
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from jaxtyping import Array

from gacrl.export.source import Source
from gacrl.types import Observation

OUTPUTS = ("action", "messages", "adjacency")
"""What a decision holds; a policy that says nothing has no messages."""


class Program(NamedTuple):
    """What the agents of one environment do in a step for what they see; nothing is drawn.

    Its inputs are `features` [N, O], `alive` [N], and `memory_0`, `memory_1`, … where the policy remembers. Its outputs
    are `action` [N] or [N, A], `messages` [R, N, V], `adjacency` [N, N], and `memory_0_next`, ….
    """

    decide: Callable[[Any, dict[str, Any]], dict[str, Array]]
    """(learner, inputs by name) -> outputs by name."""
    learner: Any
    """What the policy acts with, a tree of arrays."""
    inputs: dict[str, jax.ShapeDtypeStruct]
    outputs: dict[str, jax.ShapeDtypeStruct]
    memory: dict[str, np.ndarray]
    """The memory's inputs at an episode's start."""
    weights: dict[str, np.ndarray]
    """The numbers that the outputs depend on, by the names of docs/guides/export.md."""


def program(source: Source) -> Program:
    """Return the policy of a run's member. Raises UserError as `open_run` does."""
    run = source.opened
    env, policy = run.env, run.trainer.algorithm.policy
    leaves, structure = jax.tree.flatten(run.trainer.memory)
    fresh = {f"memory_{number}": np.asarray(leaf) for number, leaf in enumerate(leaves)}
    learner = jax.tree.map(lambda leaf: leaf[0], run.learners)

    def decide(learner: Any, inputs: dict[str, Any]) -> dict[str, Array]:
        seen = _present(env.from_features(inputs["features"]), inputs["alive"])
        memory = jax.tree.unflatten(structure, [inputs.get(name, fresh[name]) for name in fresh])
        decision, after = policy(learner, False)(memory, seen, jax.random.key(0))
        found = {name: getattr(decision, name) for name in OUTPUTS}
        found |= dict(zip([f"{name}_next" for name in fresh], jax.tree.leaves(after), strict=True))
        needed = {f"{name}_next" for name in fresh if name in inputs}
        return {name: it for name, it in found.items() if it is not None and (name in OUTPUTS or name in needed)}

    shapes = {
        "features": jax.ShapeDtypeStruct((env.num_agents, env.observation_size), jnp.float32),
        "alive": jax.ShapeDtypeStruct((env.num_agents,), jnp.bool_),
    }
    remembered = {name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for name, leaf in fresh.items()}
    read, kept = _read(decide, learner, shapes | remembered)
    paths = [name_of(jax.tree_util.keystr(path)) for path, _ in jax.tree_util.tree_leaves_with_path(learner)]
    numbers = map(np.asarray, jax.tree.leaves(learner))
    weights = {name: array for name, array, is_read in zip(paths, numbers, read, strict=True) if is_read}
    inputs = shapes | {name: remembered[name] for name in kept}
    outputs = jax.eval_shape(decide, learner, inputs)
    return Program(decide, learner, inputs, outputs, {name: fresh[name] for name in kept}, weights)


def flattened(it: Program) -> Callable[..., list[Array]]:
    """Return the program over its inputs in their order, with its numbers inside and its outputs in theirs.

    It is as plain as can be for other programs: what no output depends on is gone, the drawing of random keys among it,
    what depends on no input is a constant, and so is an array without elements.
    """

    def decided(*given: Array) -> list[Array]:
        found = it.decide(it.learner, dict(zip(it.inputs, given, strict=True)))
        return [found[name] for name in it.outputs]

    closed = jax.make_jaxpr(decided)(*it.inputs.values())
    read = live(closed.jaxpr, closed.jaxpr.outvars)
    steps = [step for step in closed.jaxpr.eqns if any(var in read for var in step.outvars)]

    def run(*given: Array) -> list[Array]:
        known: dict[Any, Any] = dict(zip(closed.jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
        known |= dict(zip(closed.jaxpr.invars, given, strict=True))
        for step in steps:
            known |= dict(zip(step.outvars, _stepped(closed, step, known), strict=True))
        return [var.val if isinstance(var, core.Literal) else known[var] for var in closed.jaxpr.outvars]

    return run


def _stepped(closed: core.ClosedJaxpr, step: core.JaxprEqn, known: dict[Any, Any]) -> list[Any]:
    """Return what a step of a program makes of the arrays so far: NumPy's where it needs no input for it."""
    makes: list[Any] = [var.aval for var in step.outvars]
    if all(array.size == 0 for array in makes):
        return [np.zeros(array.shape, array.dtype) for array in makes]
    if step.primitive.name == "concatenate":
        takes: list[Any] = [var.aval for var in step.invars]
        step = step.replace(invars=[var for var, array in zip(step.invars, takes, strict=True) if array.size])
    needed = list(dict.fromkeys(var for var in step.invars if isinstance(var, core.Var)))
    alone = closed.jaxpr.replace(constvars=(), invars=needed, outvars=step.outvars, eqns=[step])
    given = [known[var] for var in needed]
    constant = all(isinstance(array, np.ndarray) for array in given)
    with jax.ensure_compile_time_eval() if constant else nullcontext():
        found = core.jaxpr_as_fun(closed.replace(jaxpr=alone, consts=()))(*given)
        return list(map(np.asarray, found)) if constant else found


def _present(seen: Observation, alive: Array) -> Observation:
    """The observation in which those agents alone are there; a task's own graph loses the edges of the others."""
    graph = seen.adjacency
    return seen._replace(
        agent_mask=alive, adjacency=None if graph is None else graph & alive[:, None] & alive[None, :]
    )


def _read(
    decide: Callable[..., Any], learner: Any, inputs: dict[str, jax.ShapeDtypeStruct]
) -> tuple[list[bool], list[str]]:
    """Return which leaves of the learner, and which arrays of the memory, some decision depends on."""
    traced, shape = jax.make_jaxpr(decide, return_shape=True)(learner, inputs)
    jaxpr, results = traced.jaxpr, dict(zip(sorted(shape), traced.jaxpr.outvars, strict=True))
    size = len(jax.tree.leaves(learner))
    given = dict(zip(sorted(inputs), jaxpr.invars[size:], strict=True))
    kept, wanted = set[str](), {results[name] for name in results if name in OUTPUTS}
    while True:
        read = live(jaxpr, wanted)
        now = {name for name in given if f"{name}_next" in results and given[name] in read}
        if now == kept:
            return [var in read for var in jaxpr.invars[:size]], sorted(kept)
        kept, wanted = now, wanted | {results[f"{name}_next"] for name in now}


def live(jaxpr: core.Jaxpr, wanted: Iterable[Any]) -> set[Any]:
    """Return the variables of a program that the wanted ones depend on, these among them."""
    read = {var for var in wanted if isinstance(var, core.Var)}
    for step in reversed(jaxpr.eqns):
        if any(var in read for var in step.outvars):
            read |= {var for var in step.invars if isinstance(var, core.Var)}
    return read


def name_of(path: str) -> str:
    """Return what a leaf of a learner is called: its path with dots, without the place of the acting network in it."""
    dotted = re.sub(r"\[(?:'([^']*)'|(\d+))\]", r".\1\2", path).removeprefix(".")
    return re.sub(r"^(network|target)\.((agent|actor)\.)?", "", dotted)
