"""Strictness for every test: two fake devices, no silent rank promotion, shapes checked at run time."""

import contextlib
import gc
import io
import os
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compiles in half the time, and each program in one piece.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1")

os.environ.pop("COLUMNS", None)  # what is printed is as wide as in a log, wherever the tests run

import browsing
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src.lru_cache import LRUCache
from jaxtyping import config as jaxtyping_config
from jaxtyping import install_import_hook

jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("gacrl", "beartype.beartype")


_MANY_PAGES = 2 * 2**30 // 4096
"""2 GB."""
_FORTNIGHT = 14 * 24 * 3600
LONGEST = ("runs", "readme", "heard", "own")
"""Groups of files that take longest: workers begin with them, so that none is left alone with one at the end."""


_COMPILED: dict[str, Any] = {
    "jax_compilation_cache_max_size": -1,  # of a bounded one, processes with other settings break the books
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_disable_most_optimizations": True,
}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give the tests of a file to one worker, where they share what is traced, compiled and trained."""

    def group(item: pytest.Item) -> str:
        mark = item.get_closest_marker("xdist_group")
        return mark.args[0] if mark else ""

    items.sort(key=lambda item: LONGEST.index(group(item)) if group(item) in LONGEST else len(LONGEST))
    for item in items:
        if not group(item):
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


def _put_at_once(cache: LRUCache, key: str, value: bytes) -> None:
    """Add a program to the folder. JAX itself writes it bit by bit, and another worker reads what is half written."""
    unfinished = cache.path / f"{key}.{os.getpid()}-{threading.get_ident()}"
    unfinished.write_bytes(value)
    unfinished.replace(cache.path / f"{key}-cache")


def pytest_configure(config: pytest.Config) -> None:
    """Have programs compiled with little optimisation, and once: workers share a folder, which later runs find full."""
    folder = Path(config.cache.mkdir("programs")) if hasattr(config, "cache") else Path(tempfile.mkdtemp())
    for program in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another worker was quicker
            if program.stat().st_mtime < time.time() - _FORTNIGHT:
                program.unlink()
    _COMPILED["jax_compilation_cache_dir"] = str(folder)
    for name, value in _COMPILED.items():
        jax.config.update(name, value)
    gc.set_threshold(20_000, 20, 50)  # Python's own took a tenth of the time, looking for cycles in what is traced
    LRUCache.put = _put_at_once


@pytest.fixture(scope="session")
def quick_start() -> dict[str, str]:
    """The environment in which a subprocess finds the programs of the tests. It adds none: see `_put_at_once`."""
    settings = {**_COMPILED, "jax_persistent_cache_min_compile_time_secs": 1e9}
    return {**os.environ, **{name.upper(): str(value) for name, value in settings.items()}}


@pytest.fixture(scope="module", autouse=True)
def forget_programs() -> Iterator[None]:
    """Compiled programs leave the memory once they fill it: all of them together took 7 GB in each worker."""
    yield
    in_use = Path("/proc/self/statm")
    pages = int(in_use.read_text().split()[1]) if in_use.exists() else _MANY_PAGES
    if pages >= _MANY_PAGES:
        jax.clear_caches()


@cache
def _trainers() -> Callable[..., Any]:
    from gacrl.training import build

    return lru_cache(maxsize=16)(build.make_trainer)


@contextlib.contextmanager
def kept_trainers() -> Generator[None]:
    """Runs of the same settings have the same trainer, whatever their seeds: what it has traced is not traced again."""
    from gacrl import tasks
    from gacrl.config.algorithms import GacrlPaperConfig
    from gacrl.training import build, session

    make: Any = _trainers()

    def kept(config: Any, *given: Any, **named: Any) -> Any:
        if tasks.brought(config.task) is not None:  # whose name may be another's in the next test
            return make.__wrapped__(config, *given, **named)
        config = replace(config, seed=0)
        if isinstance(config.algorithm, GacrlPaperConfig):  # whose functions do not know how long a run is
            config = replace(config, training=replace(config.training, env_steps=450))
        return make(config, *given, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "make_trainer", kept)
        patch.setattr(session, "make_trainer", kept)
        yield


@pytest.fixture(scope="module")
def one_trainer() -> Iterator[None]:
    """For modules whose runs are started, resumed and played again."""
    with kept_trainers():
        yield


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Types are not checked at run time, as users call: what is wrong comes to our own checks."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


@pytest.fixture
def from_outside(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test brings from outside (tasks, messages, exploration rules, algorithms) is gone after it."""
    from gacrl import tasks
    from gacrl.config import algorithms, kinds

    monkeypatch.setattr(tasks, "_OWN", {})
    registries: tuple[dict[str, Any], ...] = (kinds.COMMUNICATION, kinds.EXPLORATION, algorithms.ALGORITHMS)
    before = [dict(registry) for registry in registries]
    yield
    for registry, kept in zip(registries, before, strict=True):
        registry.clear()
        registry.update(kept)


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A headless Chromium. Where there is none, its tests are skipped with a line that says so; `.ci/run` has one."""
    missing = browsing.chromium.missing()
    if missing and "GACRL_BROWSER" in os.environ:
        pytest.fail(missing)
    if missing:
        pytest.skip(missing)
    with browsing.chromium.opened() as found:
        yield found


def soaked(cases: Iterable[Any], *kept: Any, slow: Iterable[Any] = ()) -> list[Any]:
    """The cases: those that are kept, those that CI runs besides, and all others soaked. Each compiles its own programs."""

    def mark(case: Any) -> list[Any]:
        return [] if case in kept else [pytest.mark.slow] if case in slow else [pytest.mark.soak]

    return [pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=mark(case)) for case in cases]


def drawn(build: Any, *settings: Any, seed: int = 0) -> Any:
    """`build(*settings, key)`, a network, with numbers drawn by NumPy: nothing is compiled to make one.

    Networks with parameters of the same shapes get the same ones.
    """
    numbers = np.random.default_rng(seed)
    shapes = eqx.filter_eval_shape(build, *settings, jax.random.key(0))
    return jax.tree.map(
        lambda leaf: jnp.asarray(numbers.normal(0, max(leaf.shape[-1], 1) ** -0.5, leaf.shape), jnp.float32),
        shapes,
    )


def drawn_learner(algorithm: Any, seed: int = 0) -> Any:
    """A learner at its start, its network drawn as above."""
    shapes = eqx.filter_eval_shape(algorithm.init, jax.random.key(0), algorithm.hyper)
    learner = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    hyper = jax.tree.map(lambda number: jnp.asarray(number, float), algorithm.hyper)
    network = drawn(lambda key: algorithm.init(key, algorithm.hyper).network, seed=seed)
    learner = learner._replace(network=network, hyper=hyper)
    return learner._replace(target=network) if hasattr(learner, "target") else learner


SCRIPTED_ROW = {"reward_shaped": np.array([12.25, 12.75]), "coverage_mean_theta": np.array([0.25, 0.75])}
"""In place of the scripted policies' rows in the paper's tables, which would take longer to compile than all the rest."""


class TinyRun(NamedTuple):
    folder: Path
    words: list[str]
    """The flags that it was trained with, but for --out."""
    said: str
    """What was printed."""


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> TinyRun:
    """A run to look at, and to copy before anything is changed: two seeds, 450 steps, a checkpoint every 60.

    Tests that use it belong into the xdist group `runs`, so that it is trained once.
    """
    from gacrl.cli.main import main
    from gacrl.experiments.paper import tables as paper_tables

    folder = tmp_path_factory.mktemp("tiny") / "run"
    words = [
        *(
            "--preset",
            "paper",
            "--env-steps",
            "450",
            "--evaluation.interval",
            "60",
            "--num-seeds",
            "2",
            "--seed",
            "5",
        ),
        *("--evaluation.num-episodes", "4", "--evaluation.final-episodes", "8"),
        *("--env.max-cycles", "15", "--algorithm.replay-capacity", "500"),
    ]
    said = io.StringIO()
    with kept_trainers(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper_tables, "_play_scripted", lambda *task: SCRIPTED_ROW)
        with contextlib.redirect_stdout(said):
            assert main(["train", *words, "--out", str(folder), "--json"]) == 0
    return TinyRun(folder, words, said.getvalue())


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Runs a command: its exit code, and what it printed as errors."""
    from gacrl.cli.main import main

    def run(*words: object) -> tuple[int, str]:
        capsys.readouterr()
        code = main([str(word) for word in words])
        return code, capsys.readouterr().err

    return run


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a run but its lock."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def assert_nearly_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], strays: int = 0) -> None:
    """Within 1e-5, but for so many numbers, which are within 1e-4."""
    assert set(found) == set(expected)
    off = 0
    for path, leaf in expected.items():
        np.testing.assert_allclose(found[path], leaf, atol=1e-4 if strays else 1e-5, err_msg=path)
        off += (~np.isclose(found[path], leaf, rtol=1e-7, atol=1e-5)).sum()
    assert off <= strays
