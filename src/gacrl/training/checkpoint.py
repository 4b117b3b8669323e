"""Checkpoints: safetensors and a JSON manifest, written so that a crash at any moment leaves a good one.

A checkpoint is a folder `step-000000003750` with `state.safetensors` and `manifest.json` (format version,
fingerprint of the configuration, counters, SHA-256 of the tensors and of all this). It is written under
another name, synced to the disk, and renamed. No pickle, nothing that can run code. `best-000000003750` is
another, of the policy alone, as it was when it scored best.
"""

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import PyTree

from gacrl.algorithms.replay import Replay
from gacrl.errors import UserError, reason

FORMAT_VERSION = 1
STEP, BEST = "step-", "best-"
KEPT = {STEP: 2, BEST: 1}
"""Newest of each kind that stay; of the whole states the one before is there should the newest be damaged."""

FORMERLY = {".exploration.progress": ".exploration.coverage", ".rewards.moments.": ".rewards."}
"""What an array was called in older checkpoints."""
NEW = (".rewards.ended",)
"""Arrays that older checkpoints have not: they are zeros there."""

_TENSORS, _MANIFEST, _UNFINISHED, _DAMAGED = "state.safetensors", "manifest.json", ".unfinished-", ".damaged-"
_DAMAGE = (OSError, ValueError, KeyError, TypeError, RecursionError, safetensors.SafetensorError)
Tree = TypeVar("Tree", bound=PyTree)


class Checkpoint(NamedTuple):
    """A checkpoint that was found intact."""

    folder: Path
    env_steps: int
    fingerprint: str
    counters: dict[str, int | float]
    """What the host loop needs to go on, such as seconds spent so far; of the best policy, its score."""


def arrays(state: PyTree, replay: Replay[Any] | None = None) -> dict[str, np.ndarray]:
    """Return a state's leaves on the host, by their paths. They may be views: use them before the state is donated.

    replay: the part of it that remembers, stacked over the seeds, [seeds, rows, …]. It is cut to the rows that are
    filled; the others are zeros, and `load` makes them again.
    """
    remembered = _ids(replay)
    filled = int(np.asarray(replay.added).max()) if replay is not None else 0

    def plain(leaf: jax.Array) -> np.ndarray:
        if _is_key(leaf):
            leaf = jax.random.key_data(leaf)
        array = np.asarray(leaf, order="C")
        return np.ascontiguousarray(array[:, :filled]) if id(leaf) in remembered else array

    return {jax.tree_util.keystr(path): plain(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(state)}


def _ids(replay: Replay[Any] | None) -> set[int]:
    """Of the leaves that remember."""
    return set() if replay is None else {id(leaf) for leaf in jax.tree.leaves(replay.items)}


def serialise(named: Mapping[str, np.ndarray]) -> bytes:
    """Return the file of these arrays: a copy, which no later step of the training changes."""
    return safetensors.numpy.save(dict(named))


def save(
    folder: Path, tensors: bytes, env_steps: int, fingerprint: str, counters: dict[str, Any], kind: str = STEP
) -> Path:
    """Write serialised tensors as the newest checkpoint of this kind in `folder`, and drop those beyond `KEPT`.

    Raises OSError where it cannot be written; nothing of it is left then.
    """
    target = folder / f"{kind}{env_steps:012d}"
    unfinished = folder / f"{_UNFINISHED}{target.name}"
    manifest: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "env_steps": env_steps,
        "fingerprint": fingerprint,
        "counters": counters,
        "sha256": {_TENSORS: hashlib.sha256(tensors).hexdigest()},
    }
    manifest["checksum"] = _digest(manifest)
    for left in folder.glob(f"{_UNFINISHED}*"):  # by a process that was killed
        shutil.rmtree(left, ignore_errors=True)
    try:
        unfinished.mkdir(parents=True)
        _write_synced(unfinished / _TENSORS, tensors)
        _write_synced(unfinished / _MANIFEST, json.dumps(manifest, indent=2).encode())
        _sync_folder(unfinished)
        if target.exists():  # a damaged one, which this training made anew
            shutil.rmtree(target)
        unfinished.rename(target)
    except OSError:
        shutil.rmtree(unfinished, ignore_errors=True)  # a full disk has no room for it
        raise
    _sync_folder(folder)
    for old in _folders(folder, kind)[KEPT[kind] :]:
        shutil.rmtree(old, ignore_errors=True)
    return target


def newest(folder: Path, kind: str = STEP) -> tuple[Checkpoint, list[str]]:
    """Return the newest intact checkpoint, and a sentence for each damaged one that was passed over.

    Raises UserError when there is none.
    """
    warnings: list[str] = []
    for candidate in _folders(folder, kind):
        try:
            return _inspect(candidate), warnings
        except _DAMAGE as error:
            why = reason(error) if isinstance(error, OSError) else " ".join(str(error).split())
            warnings.append(f"checkpoint {candidate} is damaged ({why}); taking the one before it")
    what = "is damaged" if warnings else "is missing"
    raise UserError(f"every checkpoint in {folder} {what}: train the run again into a new folder")


def set_aside_damaged(folder: Path, kind: str = STEP) -> list[Path]:
    """Rename the damaged checkpoints past the newest good one, so that they are neither counted nor replaced.

    Returns where they are now.
    """
    aside: list[Path] = []
    for candidate in _folders(folder, kind):
        try:
            _inspect(candidate)
            break
        except _DAMAGE:
            target = folder / f"{_DAMAGED}{candidate.name}"
            shutil.rmtree(target, ignore_errors=True)
            aside.append(candidate.rename(target))
    return aside


def load(checkpoint: Checkpoint, like: Tree, prefix: str = "", replay: Replay[Any] | None = None) -> Tree:
    """Load the saved state in the structure of `like` (arrays or their shapes).

    prefix: the path of `like` inside the saved state, such as `.learner`. replay: the part of `like` that remembers,
    of which the empty rows were not saved. Numbers take the precision of `like`, whatever JAX computed with when they
    were saved. Raises UserError for a checkpoint of another architecture, naming the first array that differs.
    """
    remembered = _ids(replay)
    path = checkpoint.folder / _TENSORS
    with safetensors.safe_open(str(path), "np") as file:
        saved = set(file.keys())
        leaves, structure = jax.tree_util.tree_flatten_with_path(like)
        loaded: list[Any] = []
        for key_path, leaf in leaves:
            name = prefix + jax.tree_util.keystr(key_path)
            for now, before in FORMERLY.items():
                name = name if name in saved else name.replace(now, before)
            is_key = _is_key(leaf)
            wanted = jax.eval_shape(jax.random.key_data, leaf) if is_key else leaf
            found = np.zeros(wanted.shape, wanted.dtype) if name.endswith(NEW) else None
            if name in saved:
                with contextlib.suppress(AttributeError, TypeError):  # numbers of a kind that NumPy has not
                    found = file.get_tensor(name)
            if found is not None and id(leaf) in remembered:
                found = _with_empty_rows(found, wanted.shape)
            if found is None or found.shape != wanted.shape or found.dtype.kind != wanted.dtype.kind:
                has = "nothing" if found is None else f"{found.dtype}{list(found.shape)}"
                raise UserError(
                    f"{checkpoint.folder} holds another architecture: {name} is {has} there and "
                    f"{wanted.dtype}{list(wanted.shape)} here; use the config.json that it was trained with"
                )
            with np.errstate(over="ignore"):  # saved in double precision, and beyond single: infinite
                array = jnp.asarray(found.astype(wanted.dtype, copy=False))
            loaded.append(jax.random.wrap_key_data(array) if is_key else array)
    return jax.tree_util.tree_unflatten(structure, loaded)


def _with_empty_rows(saved: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """What `arrays` took away is there again; an array that differs otherwise stays as it is."""
    if saved.ndim != len(shape) or saved.shape[1] >= shape[1]:
        return saved
    return np.pad(saved, [(0, shape[1] - saved.shape[1] if axis == 1 else 0) for axis in range(saved.ndim)])


def _inspect(folder: Path) -> Checkpoint:
    """Read and verify a checkpoint; raises one of `_DAMAGE` where it is damaged."""
    manifest = json.loads((folder / _MANIFEST).read_text(encoding="utf-8"))
    if manifest["format_version"] != FORMAT_VERSION:
        raise ValueError(f"format version {manifest['format_version']}, this program reads {FORMAT_VERSION}")
    if manifest.pop("checksum") != _digest(manifest):
        raise ValueError(f"{_MANIFEST} does not match its checksum")
    env_steps, counters = manifest["env_steps"], manifest["counters"]
    if type(env_steps) is not int or not 0 <= env_steps < 10**12:
        raise ValueError(f"env_steps of {_MANIFEST} is {env_steps!r}")
    if not isinstance(counters, dict) or any(type(value) not in (int, float) for value in counters.values()):
        raise ValueError(f"counters of {_MANIFEST} are no numbers")
    with (folder / _TENSORS).open("rb") as file:
        if hashlib.file_digest(file, "sha256").hexdigest() != manifest["sha256"][_TENSORS]:
            raise ValueError(f"{_TENSORS} does not match its checksum")
    with safetensors.safe_open(str(folder / _TENSORS), "np"):
        pass  # raises where it is no such file, whatever its checksum
    return Checkpoint(folder, env_steps, str(manifest["fingerprint"]), counters)


def _digest(manifest: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


def _folders(folder: Path, kind: str) -> list[Path]:
    """The checkpoints' folders, newest first."""
    return sorted(folder.glob(f"{kind}*"), reverse=True) if folder.is_dir() else []


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
