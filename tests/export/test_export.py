"""What leaves the house: weights by name, programs that decide as the run does, numbers; and the sentences of what cannot."""

import csv
import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import safetensors.numpy
from conftest import TinyRun, drawn_learner

from gacrl import export as formats
from gacrl.config import files as configuration
from gacrl.config import presets
from gacrl.export.program import flattened, program
from gacrl.export.recorded import compared, record
from gacrl.export.source import Source
from gacrl.play import TrainedRun
from gacrl.training import build

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.xdist_group("runs")


class Written(NamedTuple):
    folder: Path
    source: Source


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """The shipped policy of spread, as both kinds of weights."""
    folder, source = tmp_path_factory.mktemp("export"), Source("pretrained:gacrl")
    for name in ("npz", "safetensors"):
        formats.writer(name)(source, folder / f"policy.{name}")
    return Written(folder, source)


def without(packages: str, *words: str) -> str:
    """What a program prints in a Python that has none of these packages."""
    bar = f"import sys; sys.modules.update(dict.fromkeys({packages.split()!r})); import runpy; sys.argv = sys.argv[1:]; "
    run = [sys.executable, "-c", bar + "runpy.run_path(sys.argv[0], run_name='__main__')", *words]
    return subprocess.run(run, capture_output=True, text=True, check=True).stdout


def test_weights_are_those_that_act_by_name(written: Written):
    plain = dict(np.load(written.folder / "policy.npz", allow_pickle=False))
    safe = safetensors.numpy.load_file(written.folder / "policy.safetensors")
    assert plain.keys() == safe.keys()
    assert all(np.array_equal(plain[name], safe[name]) for name in plain)
    acting = written.source.opened.learners.target.agent  # the averaged network is played
    assert np.array_equal(plain["torso.out.layers.0.weight"], acting.torso.out.layers[0].weight[0])
    assert np.array_equal(plain["communication.encode.1.bias"], acting.communication.encode[1].bias[0])
    unread = [
        name for name in plain if name.startswith(("code.decode", "optimizer", "hyper", "network", "target"))
    ]
    assert not unread, "the decoder serves the loss alone"


def test_the_card_says_what_the_files_do_not(written: Written):
    card = (written.folder / "policy.npz.md").read_text()
    for said in (
        "| 1 | push left |",
        '"rounds": 2',
        "`head.bias` | [5]",
        "seed 0",
        "150,000 environment steps",
        '"max_cycles": 25',
        "| in | `features` | float32[3, 18] |",
        "| out | `messages` | float32[2, 3, 16] |",
    ):
        assert said in card, said


def test_a_program_without_jax_and_gacrl_decides_as_the_run(written: Written):
    """examples/run_without_jax.py, over 1,000 recorded decisions, their messages included; then on its own."""
    spec = importlib.util.spec_from_file_location("alone", ROOT / "examples" / "run_without_jax.py")
    assert spec is not None and spec.loader is not None
    alone = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(alone)
    weights = dict(np.load(written.folder / "policy.npz"))

    def run(inputs: dict[str, Any]) -> dict[str, Any]:
        actions, said = alone.decide(weights, inputs["features"])
        return {"action": actions, "messages": np.eye(16)[said], "adjacency": recorded["adjacency"]}

    recorded = {"adjacency": np.ones((3, 3), bool) ^ np.eye(3, dtype=bool)}
    it = program(written.source)
    spoken = it._replace(outputs={name: shape for name, shape in it.outputs.items() if name != "adjacency"})
    assert "It repeats 1,000 of 1,000" in compared(written.source, spoken, run)
    told = without("jax gacrl", str(ROOT / "examples" / "run_without_jax.py"), str(written.folder / "policy.npz"))
    share = float(told.split("%")[0].split()[-1])
    assert share > 90, told


def test_a_trained_policy_plays_in_the_real_mpe2():
    told = without("", str(ROOT / "examples" / "play_in_mpe2.py"))
    assert -12 < float(told.split()[-1]) < -3, "random agents earn about -20"


def untrained(preset: str, task: str, **network: Any) -> Source:
    """A source of a policy that has learned nothing."""
    config = configuration.on_task(presets.preset(preset), task)
    config = replace(config, num_seeds=1, algorithm=replace(config.algorithm, **_of(config, network)))
    trainer = build.make_trainer(config, learns=False)
    acting = trainer.algorithm.acting(drawn_learner(trainer.algorithm))
    run = TrainedRun("untrained", config, trainer, jax.tree.map(lambda leaf: leaf[None], acting), 0)
    source = Source("untrained")
    source.__dict__["opened"] = run  # a cached property
    return source


def _of(config: Any, network: dict[str, Any]) -> dict[str, Any]:
    return {"network": replace(config.algorithm.network, **network)} if network else {}


@pytest.mark.parametrize(
    ("preset", "task", "network", "remembered"),
    [
        ("vdn", "reference", {"recurrent": True, "communication": "dial"}, True),
        ("ippo", "traffic_junction", {"communication": "discrete", "gate": True}, False),
        ("paper", "spread", {}, False),
    ],
)
def test_programs_of_every_kind_decide_as_the_policy(
    preset: str, task: str, network: dict[str, Any], remembered: bool
):
    """A memory goes in and comes out; absent agents are said to be; an algorithm's own networks are found."""
    source = untrained(preset, task, **network)
    it = program(source)
    assert bool(it.memory) == remembered
    assert not any(name.startswith(("critic", "hyper.learning", "optimizer")) for name in it.weights)
    call = jax.jit(flattened(it))

    def run(inputs: dict[str, Any]) -> dict[str, Any]:
        return dict(zip(it.outputs, call(*(inputs[name] for name in it.inputs)), strict=True))

    assert "It repeats 100 of 100" in compared(source, it, run, 100)
    shown = record(source, it, 100).inputs
    assert shown["alive"].all() == (task != "traffic_junction")
    if remembered:
        assert any(np.ptp(shown[name]) > 0 for name in it.memory)


def test_stablehlo_decides_as_the_run(written: Written, tmp_path: Path):
    pytest.importorskip("flatbuffers", reason="pip install 'gacrl[onnx]'")
    out = tmp_path / "policy.stablehlo"
    formats.writer("stablehlo")(written.source, out)
    assert "It repeats 1,000 of 1,000" in (tmp_path / "policy.stablehlo.md").read_text()
    assert "stablehlo.dot_general" in jax.export.deserialize(out.read_bytes()).mlir_module()


@pytest.mark.parametrize("name", ["gacrl", "gacrl-reference"])
def test_onnx_decides_as_the_run(name: str, tmp_path: Path):
    """The second one has axes of length 0: its agents see nobody."""
    pytest.importorskip("jax2onnx", reason="pip install 'gacrl[onnx]'")
    onnxruntime = pytest.importorskip("onnxruntime", reason="pip install 'gacrl[onnx]'")
    out, before = tmp_path / "policy.onnx", dict(vars(jax.numpy))
    formats.writer("onnx")(Source(f"pretrained:{name}"), out)
    assert not [name for name, it in before.items() if vars(jax.numpy)[name] is not it], "JAX is as it was"
    card = (tmp_path / "policy.onnx.md").read_text()
    assert "It repeats 1,000 of 1,000" in card and "Opset 21" in card
    session = onnxruntime.InferenceSession(out.read_bytes(), providers=["CPUExecutionProvider"])
    assert [it.name for it in session.get_inputs()] == ["features", "alive"]
    assert [it.name for it in session.get_outputs()] == ["action", "adjacency", "messages"]
    nodes = pytest.importorskip("onnx").load(out).graph.node
    kinds = {node.op_type for node in nodes}
    assert (
        {"Relu", "LeakyRelu", "MatMul"} <= kinds and "Einsum" not in kinds and not any(it.domain for it in nodes)
    )


def test_what_decides_otherwise_is_not_written(written: Written):
    it = program(written.source)
    lazy = {name: np.zeros(shape.shape, shape.dtype) for name, shape in it.outputs.items()}
    with pytest.raises(Exception, match="decides otherwise than the run in .* of 100 decisions"):
        compared(written.source, it, lambda inputs: lazy, 100)


def test_metrics_as_a_table(tiny_run: TinyRun, tmp_path: Path, said: Callable[..., tuple[int, str]]):
    assert said("export", tiny_run.folder, "--out", tmp_path / "metrics.csv") == (0, "")
    rows = [json.loads(line) for line in (tiny_run.folder / "metrics.jsonl").read_text().splitlines()]
    with (tmp_path / "metrics.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [(int(line["seed"]), int(line["env_steps"])) for line in table] == [
        (row["seed"], row["env_steps"]) for row in rows
    ]
    for line, row in zip(table, rows, strict=True):
        assert float(line["greedy.return_agent_mean"]) == row["greedy"]["return_agent_mean"]
        assert row["update"]
        assert all(float(line[f"update.{name}"]) == value for name, value in row["update"].items())


def test_sentences(tiny_run: TinyRun, tmp_path: Path, said: Callable[..., tuple[int, str]], monkeypatch: Any):
    out, run = tmp_path / "policy.npz", tiny_run.folder
    (tmp_path / "there.npz").touch()
    damaged = tmp_path / "damaged"
    shutil.copytree(run, damaged)
    (damaged / "summary.json").write_text("{")
    for words, sentence in (
        ((run,), "say where with --out FILE"),
        ((run, "--out", tmp_path / "policy"), "does not say which format"),
        ((run, "--out", out, "--format", "npy"), "unknown format 'npy': did you mean 'npz'?"),
        ((run, "--out", out, "--format", "csv"), "is called like a file of npz, and --format says csv"),
        ((run, "--out", tmp_path / "there.npz"), "exists: choose another --out, or say --overwrite"),
        ((run, "--out", tmp_path / "no" / "x.npz"), "there is no folder"),
        ((run, "--out", out, "--num-agent", 4), "did you mean --num-agents?"),
        ((f"{run}@7", "--out", out), "there is no @7"),
        (("oracle", "--out", out), "oracle is a script"),
        ((damaged, "--out", out), "summary.json is damaged"),
        (("pretrained:gacrl", "--out", tmp_path / "x.csv"), "has no metrics.jsonl with an evaluation in it"),
    ):
        code, told = said("export", *words)
        assert (code, sentence in told, told.count("\n")) == (2, True, 1), told
    monkeypatch.setattr("gacrl.extras.find_spec", lambda name: None)
    for name in ("onnx", "stablehlo"):
        code, told = said("export", run, "--out", tmp_path / f"x.{name}")
        assert code == 2 and "pip install 'gacrl[onnx]'" in told, told
    assert sorted(tmp_path.iterdir()) == [damaged, tmp_path / "there.npz"], "nothing is left of what failed"
