"""Checkpoints: safetensors and a JSON manifest, written so that a crash at any moment leaves a good one.

A checkpoint is a folder `step-000000003750` with `state.safetensors` and `manifest.json` (format version,
fingerprint of the configuration, counters, SHA-256 of the tensors and of all this). It is written under
another name, synced to the disk, and renamed. No pickle, nothing that can run code.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import PyTree

from gacrl.errors import UserError

FORMAT_VERSION = 1
KEPT = 2
"""Newest checkpoints that stay; the one before the newest is there should the newest be damaged."""

_TENSORS, _MANIFEST, _PREFIX = "state.safetensors", "manifest.json", "step-"
Tree = TypeVar("Tree", bound=PyTree)


class Checkpoint(NamedTuple):
    """A checkpoint that was found intact."""

    folder: Path
    env_steps: int
    fingerprint: str
    counters: dict[str, Any]
    """What the host loop needs to go on: seconds spent so far."""


def save(
    folder: Path,
    state: PyTree,
    env_steps: int,
    fingerprint: str,
    counters: dict[str, Any],
    skip: tuple[str, ...] = (),
) -> Path:
    """Write the state as the newest checkpoint in `folder` and drop the oldest beyond `KEPT`.

    skip: paths inside the state that are left out.
    """
    target = folder / f"{_PREFIX}{env_steps:012d}"
    unfinished = folder / f".unfinished-{target.name}"
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    tensors = safetensors.numpy.save(_to_arrays(state, skip))
    manifest: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "env_steps": env_steps,
        "fingerprint": fingerprint,
        "counters": counters,
        "sha256": {_TENSORS: hashlib.sha256(tensors).hexdigest()},
    }
    manifest["checksum"] = _digest(manifest)
    _write_synced(unfinished / _TENSORS, tensors)
    _write_synced(unfinished / _MANIFEST, json.dumps(manifest, indent=2).encode())
    _sync_folder(unfinished)
    if target.exists():  # a run extended or replayed over the same step
        shutil.rmtree(target)
    unfinished.rename(target)
    _sync_folder(folder)
    for old in _folders(folder)[KEPT:]:
        shutil.rmtree(old, ignore_errors=True)
    return target


def newest(folder: Path) -> tuple[Checkpoint, list[str]]:
    """The newest intact checkpoint, and a sentence for each damaged one that was passed over.

    Raises UserError when there is none.
    """
    warnings: list[str] = []
    for candidate in _folders(folder):
        try:
            return _inspect(candidate), warnings
        except (OSError, ValueError, KeyError, TypeError) as error:
            warnings.append(f"checkpoint {candidate} is damaged ({error}); taking the one before it")
    what = "is damaged" if warnings else "is missing"
    raise UserError(f"every checkpoint in {folder} {what}: train the run again into a new folder")


def load(checkpoint: Checkpoint, like: Tree, prefix: str = "", skip: tuple[str, ...] = ()) -> Tree:
    """The saved state in the structure of `like` (arrays or their shapes).

    prefix: the path of `like` inside the saved state, such as `.learner`. skip: paths inside `like`, such as
    `.replay`, that are not looked for and come as zeros. Raises UserError for a checkpoint
    of another architecture, naming the first array that differs.
    """
    path = checkpoint.folder / _TENSORS
    with safetensors.safe_open(str(path), "np") as file:
        saved = set(file.keys())
        leaves, structure = jax.tree_util.tree_flatten_with_path(like)
        loaded: list[Any] = []
        for key_path, leaf in leaves:
            inside = jax.tree_util.keystr(key_path)
            if inside.startswith(skip):
                loaded.append(jnp.zeros(leaf.shape, leaf.dtype))
                continue
            name = prefix + inside
            is_key = _is_key(leaf)
            wanted = jax.eval_shape(jax.random.key_data, leaf) if is_key else leaf
            found = file.get_tensor(name) if name in saved else None
            if found is None or found.shape != wanted.shape or found.dtype != wanted.dtype:
                has = "nothing" if found is None else f"{found.dtype}{list(found.shape)}"
                raise UserError(
                    f"{checkpoint.folder} holds another architecture: {name} is {has} there and "
                    f"{wanted.dtype}{list(wanted.shape)} here; use the config.json that it was trained with"
                )
            array = jnp.asarray(found)
            loaded.append(jax.random.wrap_key_data(array) if is_key else array)
    return jax.tree_util.tree_unflatten(structure, loaded)


def _inspect(folder: Path) -> Checkpoint:
    """Read and verify a checkpoint; raises ValueError, KeyError, TypeError or OSError where it is damaged."""
    manifest = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
    if manifest["format_version"] != FORMAT_VERSION:
        raise ValueError(f"format version {manifest['format_version']}, this program reads {FORMAT_VERSION}")
    if manifest.pop("checksum") != _digest(manifest):
        raise ValueError(f"{_MANIFEST} does not match its checksum")
    for name, digest in manifest["sha256"].items():
        if hashlib.sha256((folder / name).read_bytes()).hexdigest() != digest:
            raise ValueError(f"{name} does not match its checksum")
    return Checkpoint(folder, int(manifest["env_steps"]), manifest["fingerprint"], manifest["counters"])


def _digest(manifest: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _folders(folder: Path) -> list[Path]:
    """The checkpoints' folders, newest first."""
    return sorted(folder.glob(f"{_PREFIX}*"), reverse=True) if folder.is_dir() else []


def _to_arrays(state: PyTree, skip: tuple[str, ...]) -> dict[str, np.ndarray]:
    def plain(leaf: jax.Array) -> np.ndarray:
        if _is_key(leaf):
            leaf = jax.random.key_data(leaf)
        return np.asarray(leaf, order="C")

    named = ((jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(state))
    return {name: plain(leaf) for name, leaf in named if not name.startswith(skip)}


def _is_key(leaf: jax.Array | jax.ShapeDtypeStruct) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
