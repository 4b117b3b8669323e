"""The network that acts, for a program without JAX: its settings, and its weights as one row of numbers."""

import base64
from typing import Any

import jax
import numpy as np

from gacrl.networks.agent import AgentNetwork
from gacrl.play import TrainedRun
from gacrl.training.devices import one_seed

SETTINGS = (
    *("communication", "rounds", "vocabulary", "speaker_identity", "latent", "latent_size"),
    *(
        "second_look",
        "look_sharpness",
        "seen_slope",
        "heard_slope",
        "radius",
        "nearest_landmarks",
        "nearest_agents",
    ),
)
"""What of `NetworkConfig` decides how the page's network acts."""


def network(opened: TrainedRun) -> dict[str, Any] | None:
    """Return {settings, tensors: {name: [rows, first, size]}, data}; None for a network the page does not know.

    The page knows entity graphs without memory, silent or with symbols that are always said, in discrete actions.
    data: float32 in base64, little-endian; a tensor is `size` numbers of it from `first` on.
    """
    config, find = getattr(opened.config.algorithm, "network", None), opened.trainer.algorithm.network
    if config is None or find is None or opened.env.continuous_actions:
        return None
    if (
        config.torso != "graph"
        or config.recurrent
        or config.gate
        or config.communication not in ("discrete", "none")
    ):
        return None
    found = find(one_seed(opened.learners, 0))
    settings = {name: getattr(config, name) for name in SETTINGS} | {"num_agents": opened.env.num_agents}
    settings |= {"draws": opened.trainer.algorithm.draws}
    return {"settings": settings, **_weights(found)}


def _weights(network: AgentNetwork) -> dict[str, Any]:
    """Write the arrays one after the other; names are paths with dots."""
    parts: list[np.ndarray] = []
    tensors: dict[str, list[int]] = {}
    first = 0
    for path, leaf in jax.tree_util.tree_leaves_with_path(network):
        array = np.asarray(leaf, "<f4")
        tensors[jax.tree_util.keystr(path, simple=True, separator=".")] = [array.shape[0], first, array.size]
        parts.append(array.ravel())
        first += array.size
    return {"tensors": tensors, "data": base64.b64encode(np.concatenate(parts).tobytes()).decode()}
