"""How a GPU is asked for, before JAX has started and could say whether there is one."""

import importlib.util
import os
from pathlib import Path

import jax

from gacrl.errors import UserError

KNOWN = jax.__version__.startswith(("0.10.", "0.11."))
"""Whether this version's XLA knows the flags below: it ends the process for one that it does not know."""
QUICKLY = "--xla_gpu_autotune_level=0 --xla_gpu_experimental_enable_fusion_autotuner=false"
"""XLA tries no variants of products and fusions of a few thousand numbers: that takes longer than it saves.

On an H100 the first alone took the compiling of ten seeds from 238 to 89 s (docs/results.md, "On a GPU"). What the
autotuner found, where it is on, JAX keeps beside the compiled programs.
"""
_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")
_NODES = ("nvidia[0-9]*", "dxg")
"""What a GPU is in /dev; the latter under Windows' Linux."""
_DEV = Path("/dev")


def flags(otherwise: str | None) -> str | None:
    """Return XLA's flags for an NVIDIA GPU where JAX will compute on one, else `otherwise`; None for none.

    Raises UserError where the user asks for a GPU that JAX was installed without.
    """
    wanted = {name for name in os.environ.get("JAX_PLATFORMS", "").split(",") if name}
    able = any(importlib.util.find_spec(plugin) is not None for plugin in _PLUGINS)
    if wanted and wanted <= {"cuda", "gpu"} and not able:
        raise UserError(
            f"JAX_PLATFORMS={os.environ['JAX_PLATFORMS']} asks for a GPU, and JAX is installed without: unset it to "
            "train on the CPU, or pip install 'jax[cuda13]'"
        )
    if (wanted and not wanted & {"cuda", "gpu"}) or os.environ.get("CUDA_VISIBLE_DEVICES") in ("", "-1"):
        return otherwise
    if not (able and any(any(_DEV.glob(node)) for node in _NODES)):
        return otherwise
    return QUICKLY if KNOWN else None
