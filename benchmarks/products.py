"""The matrix products in a program, counted from its jaxpr: how many, of which shapes, and how fast they are alone."""

import math
import time
from collections import Counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxprs_in_params


class Product(NamedTuple):
    """A product of two arrays; `dimensions` is dot_general's."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    dimensions: Any

    @property
    def flops(self) -> int:
        """Multiplications and additions."""
        (_, contracted), (_, batch) = self.dimensions
        free = [size for axis, size in enumerate(self.right) if axis not in (*contracted, *batch)]
        return 2 * math.prod(self.left) * math.prod(free)


def products(jaxpr: Any) -> Counter[Product]:
    """Those of one run of a jaxpr: scans by their length, of branches the dearer one, of other loops one turn."""
    found: Counter[Product] = Counter()
    for equation in jaxpr.eqns:
        name, settings = equation.primitive.name, equation.params
        if name == "dot_general":
            left, right = (variable.aval.shape for variable in equation.invars)
            found[Product(left, right, settings["dimension_numbers"])] += 1
        elif name == "cond":
            found += max((products(branch.jaxpr) for branch in settings["branches"]), key=total)
        else:
            times = settings["length"] if name == "scan" else 1
            for inner in jaxprs_in_params(settings):
                found += Counter({product: times * count for product, count in products(inner).items()})
    return found


def total(found: Counter[Product]) -> int:
    """Multiplications and additions of all of them."""
    return sum(product.flops * count for product, count in found.items())


def alone(product: Product, seconds: float = 0.02) -> float:
    """Seconds of CPU time that it takes, run again and again on its own."""
    rng = np.random.default_rng(0)
    left, right = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in (product.left, product.right))

    @jax.jit
    def again(left: Any, right: Any, turns: int) -> Any:
        def turn(_: int, carry: Any) -> Any:
            left, seen = carry
            result = jax.lax.dot_general(left, right, product.dimensions)
            return left.at[(0,) * left.ndim].add(1e-30 * result.ravel()[0]), seen + result.ravel()[-1]

        return jax.lax.fori_loop(0, turns, turn, (left, 0.0))[1]

    def measure(turns: int) -> float:
        begun = time.process_time()
        again(left, right, turns).block_until_ready()
        return (time.process_time() - begun) / turns

    measure(1)
    return measure(max(1, round(seconds / max(measure(3), 1e-7))))
