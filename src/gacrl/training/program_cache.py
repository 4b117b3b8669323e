"""Compiled programs are kept in the user's cache folder, so that a second start is quick."""

import os
import sys
import tempfile
import warnings
from pathlib import Path

import jax

from gacrl.errors import reason

_BYTES = 512 * 2**20
"""Bound of the folder; the oldest programs go first."""


def keep() -> None:
    """Have JAX keep what it compiles, unless the user has named a place already."""
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        folder = make_folder()
        if folder is not None:
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_compilation_cache_max_size", _BYTES)
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    # Full later on, or held by another process for long: what is not kept is compiled again, and nobody need know.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache", UserWarning)


def make_folder() -> Path | None:
    """Make and return the folder; None, and a line on stderr, where nothing can be written."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gacrl" / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as trial:
            trial.write(bytes(2**20))
    except OSError as error:
        print(
            f"gacrl: {folder} keeps no compiled programs: {reason(error)}; each start compiles anew",
            file=sys.stderr,
        )
        return None
    return folder
