"""Bad input, searched for: whatever stands in a run folder, a command succeeds or ends in one sentence and exit code 2.

GACRL_FUZZ says how many inputs each search tries; `make soak` tries more.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy
from conftest import TinyRun
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gacrl.cli.main import main
from gacrl.config import files as configuration
from gacrl.config.presets import PRESETS
from gacrl.config.run import RunConfig
from gacrl.errors import ConfigError, UserError
from gacrl.experiments import scoring
from gacrl.experiments.paper import tables as paper_tables
from gacrl.tasks.spread.settings import METRICS
from gacrl.training import build, checkpoint, session

pytestmark = [
    pytest.mark.usefixtures("one_trainer"),
    pytest.mark.xdist_group("runs"),
    # Whatever thread draws from `random` while a strategy runs, it is none of ours.
    pytest.mark.filterwarnings("ignore:Do not use the `random` module inside strategies"),
]

FEW = int(os.environ.get("GACRL_FUZZ", "25"))
MANY = 25 * FEW
BUILD = build.make_trainer
COMMANDS = ("resume", "evaluate", "compare")


def searched(count: int) -> Any:
    """The same inputs every time: a new fault is found by looking further, not by chance in somebody's change."""
    quiet = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]
    return settings(
        max_examples=count, deadline=None, derandomize=True, database=None, suppress_health_check=quiet
    )


@pytest.fixture(scope="module", autouse=True)
def nothing_drawn() -> Iterator[None]:
    """What is searched is what reads: scripted policies and pictures are not made."""
    with pytest.MonkeyPatch.context() as patch:
        references = {
            name: dict.fromkeys(METRICS, float(k)) for k, name in enumerate(("random", "noop", "oracle"))
        }
        patch.setattr(session, "evaluate_scripted", lambda *_: references)
        patch.setattr(scoring, "_references", lambda *_: references)
        patch.setattr(session.episodes, "cut", lambda *_: [])
        patch.setattr(session.reel, "gif", lambda *_, **__: None)
        patch.setattr(paper_tables, "table_2", lambda *_: [])
        patch.setattr(paper_tables, "table_3", lambda *_: [])
        yield


def content(folder: Path) -> dict[str, Any]:
    """Every file and link, but for the lock and what resuming puts out of the way."""
    return {
        str(path.relative_to(folder)): path.readlink() if path.is_symlink() else path.read_bytes()
        for path in folder.rglob("*")
        if (path.is_symlink() or path.is_file()) and path.name != ".lock" and ".damaged" not in str(path)
    }


def run(words: tuple[str, ...]) -> tuple[int, str]:
    """A command's exit code and what it printed as errors; an exception of it is this test's."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        code = main(words)
    return code, errors.getvalue()


def assert_success_or_a_sentence(folder: Path, command: str) -> None:
    before = content(folder)
    code, said = run((command, str(folder)))
    assert code in (0, 2), (code, said)
    assert all(line.startswith("gacrl: ") for line in said.splitlines()), said
    if code == 2:
        assert said, "it says why"
        after = content(folder)
        kept = {name: it for name, it in after.items() if name in before}
        assert kept == before or command == "resume", "what refuses changes nothing"
        assert {name for name in before if name not in after and "step-000000000450" not in name} == set()


# Run folders.

THINGS = (
    "config.json",
    "metrics.jsonl",
    "summary.json",
    "episodes",
    "episodes.gif",
    ".metrics.jsonl.unfinished",
    ".lock",
    "checkpoints",
    "checkpoints/step-000000000450",
    "checkpoints/step-000000000450/manifest.json",
    "checkpoints/step-000000000450/state.safetensors",
    "checkpoints/step-000000000420/manifest.json",
    "checkpoints/best",
    "checkpoints/best/manifest.json",
    "checkpoints/best/state.safetensors",
)


@st.composite
def damages(draw: st.DrawFn) -> tuple[str, str, Any]:
    """A thing of a run folder, what is done to it, and where or with what."""
    what = draw(
        st.sampled_from(["missing", "empty", "cut", "bytes", "folder", "binary", "link", "dangling", "text"])
    )
    return (
        draw(st.sampled_from(THINGS)),
        what,
        draw(st.floats(0, 1) if what in ("cut", "bytes") else st.text(max_size=9)),
    )


def spoil(folder: Path, outside: Path, thing: str, what: str, how: Any) -> None:
    if thing.startswith("checkpoints/best"):
        best = next(iter(folder.glob("checkpoints/best-*")), folder / "checkpoints/best-0")
        thing = thing.replace("checkpoints/best", f"checkpoints/{best.name}")
    path = folder / thing
    data = path.read_bytes() if path.is_file() else b""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.is_dir():
        shutil.rmtree(path)
    if what == "missing" or not path.parent.is_dir():
        return
    if what == "folder":
        path.mkdir()
        (path / "x").write_text("x")
    elif what == "link":
        path.symlink_to(outside)
    elif what == "dangling":
        path.symlink_to(outside / "nothing")
    elif what == "cut":
        path.write_bytes(data[: int(how * len(data))])
    elif what == "bytes":
        position = int(how * max(len(data) - 1, 0))
        path.write_bytes(data[:position] + b"\x55" + data[position + 1 :])
    else:
        path.write_bytes({"empty": b"", "binary": b"\x00\xff{"}.get(what, str(how).encode()))


def check_damages(tiny_run: TinyRun, damage: list[tuple[str, str, Any]], link_to_file: bool, command: str) -> None:
    with tempfile.TemporaryDirectory() as made:
        folder, outside = Path(shutil.copytree(tiny_run.folder, Path(made) / "run")), Path(made) / "outside"
        if link_to_file:
            outside.write_text("years of work")
        else:
            outside.mkdir()
            (outside / "thesis.tex").write_text("years of work")
        for thing, what, how in damage:
            spoil(folder, outside, thing, what, how)
        assert_success_or_a_sentence(folder, command)
        kept = outside if link_to_file else outside / "thesis.tex"
        assert kept.read_text() == "years of work", "a link leads nobody out of the folder"


ANY_DAMAGE = (st.lists(damages(), min_size=1, max_size=3), st.booleans(), st.sampled_from(COMMANDS))


@searched(FEW)
@given(*ANY_DAMAGE)
def test_a_spoilt_run_folder(tiny_run: TinyRun, damage: Any, link_to_file: bool, command: str):
    check_damages(tiny_run, damage, link_to_file, command)


@pytest.mark.soak
@searched(MANY)
@given(*ANY_DAMAGE)
def test_many_spoilt_run_folders(tiny_run: TinyRun, damage: Any, link_to_file: bool, command: str):
    check_damages(tiny_run, damage, link_to_file, command)


# JSON with other values in it, checksums and all.

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.just(10**400),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def paths(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield here
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in inner:
        yield from paths(item, (*here, key))


def changed(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    made = dict(value) if isinstance(value, dict) else list(value)
    if new is ... and len(path) == 1:
        del made[path[0]]
    else:
        made[path[0]] = changed(value[path[0]], path[1:], new)
    return made


FILES = ("config.json", "metrics.jsonl", "summary.json", "checkpoints/step-000000000450/manifest.json")
ANY_VALUE = (
    st.sampled_from(FILES),
    st.floats(0, 1, exclude_max=True),
    JSON | st.just(...),
    st.sampled_from(COMMANDS),
)


def check_value(tiny_run: TinyRun, name: str, where: float, new: Any, command: str) -> None:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(shutil.copytree(tiny_run.folder, Path(made) / "run"))
        path = folder / name
        lines = path.read_text().splitlines() if name.endswith("l") else [path.read_text()]
        number = int(where * len(lines))
        value = json.loads(lines[number])
        places = [place for place in paths(value) if place or new is not ...]
        lines[number] = value = changed(value, places[int(where * 7919 * len(places)) % len(places)], new)
        if "manifest" in name and isinstance(value, dict):  # as one who knows how to sign it
            unsigned = {key: it for key, it in value.items() if key != "checksum"}
            value["checksum"] = hashlib.sha256(json.dumps(unsigned, sort_keys=True).encode()).hexdigest()
        lines[number] = json.dumps(value)
        path.write_text("\n".join(lines) + "\n")
        assert_success_or_a_sentence(folder, command)


@searched(FEW)
@given(*ANY_VALUE)
def test_any_value_in_a_file_of_a_run(tiny_run: TinyRun, name: str, where: float, new: Any, command: str):
    check_value(tiny_run, name, where, new, command)


@pytest.mark.soak
@searched(MANY)
@given(*ANY_VALUE)
def test_many_values_in_the_files_of_a_run(tiny_run: TinyRun, name: str, where: float, new: Any, command: str):
    check_value(tiny_run, name, where, new, command)


# Safetensors that are none, with a checksum that fits.

TENSORS = safetensors.numpy.save({"w": np.arange(6, dtype=np.float32), "n": np.arange(3, dtype=np.int32)})
LIKE = {"w": jax.ShapeDtypeStruct((6,), np.float32), "n": jax.ShapeDtypeStruct((3,), np.int32)}


@searched(10 * FEW)
@given(
    st.binary(max_size=200)
    | st.tuples(st.integers(0, len(TENSORS) - 1), st.binary(max_size=8)).map(
        lambda it: TENSORS[: it[0]] + it[1] + TENSORS[it[0] + len(it[1]) :]
    )
    | st.builds(
        lambda header, data: len(json.dumps(header)).to_bytes(8, "little") + json.dumps(header).encode() + data,
        st.dictionaries(
            st.sampled_from(["['w']", "['n']"]),
            st.fixed_dictionaries(
                {
                    "dtype": st.sampled_from(["F32", "F64", "I64", "BF16", "F8_E4M3", "C64", "X"]),
                    "shape": st.lists(st.integers(-1, 9), max_size=2),
                    "data_offsets": st.lists(st.integers(-1, 80), min_size=2, max_size=2),
                }
            ),
        ),
        st.binary(max_size=80),
    )
)
def test_tensors_that_are_none(data: bytes):
    with tempfile.TemporaryDirectory() as made:
        checkpoint.save(Path(made), data, 1, "", {})
        with contextlib.suppress(UserError):
            found, _ = checkpoint.newest(Path(made))
            checkpoint.load(found, LIKE)


# Settings.


def numbers(config: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """The path and the type of every setting."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{where}{field.name}.")
        elif where + field.name != "preset":
            yield where + field.name, value


EXTREMES = (
    1,
    2,
    3,
    7,
    100,
    65_536,
    10**6,
    10**7,
    10**9,
    10**12,
    0.0,
    1e-6,
    0.5,
    1.0,
    100.0,
    1e6,
    None,
    True,
    False,
)


@st.composite
def extreme(draw: st.DrawFn) -> RunConfig:
    """A preset with some settings at any value that they may have."""
    config: RunConfig = PRESETS[draw(st.sampled_from(list(PRESETS)))][1]
    for path, _ in draw(st.lists(st.sampled_from(list(numbers(config))), min_size=1, max_size=4)):
        data: Any = draw(st.sampled_from(EXTREMES))
        for key in reversed(path.split(".")):
            data = {key: data}
        with contextlib.suppress(ConfigError):
            config = configuration.from_dict(data, config)
    return config


def check_plan(config: RunConfig) -> None:
    with contextlib.suppress(UserError):
        planned = build.plan(BUILD(config), config)
        assert planned.bytes_needed >= planned.bytes_per_seed > 0


@searched(max(FEW // 4, 1))
@given(extreme())
def test_any_settings_are_planned_or_refused(config: RunConfig):
    check_plan(config)


@pytest.mark.soak
@searched(MANY // 4)
@given(extreme())
def test_many_settings_are_planned_or_refused(config: RunConfig):
    check_plan(config)
