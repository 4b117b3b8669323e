"""What the benchmarks share: peers in environments of their own, their programs, processes that take turns, ratios.

A peer lives under `.bench/NAME`, made at the first call. One that cannot be installed is said so, and skipped.
Times are CPU seconds of one thread on one core, so that other work on the machine counts as little as it can; the
figures are ratios of two sides that took turns.
"""

import contextlib
import importlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

try:
    from benchmarl.experiment import Callback
except ImportError:  # in everyone else's environment
    Callback = object

HERE = Path(__file__).resolve().parent
ROOMS = HERE.parent / ".bench"
TORCH = "torch==2.13.0"
PACKAGES = {
    "torch": (TORCH, "mpe2", "numpy"),
    "jaxmarl": ("jaxmarl==0.2.0", "distrax", "flashbax", "hydra-core", "omegaconf", "wandb"),
    "benchmarl": (TORCH, "benchmarl==1.5.2", "vmas==1.5.2", "pettingzoo==1.24.3", "pygame"),
}
BASELINES = {
    "ippo": ("IPPO", "ippo_ff_mpe", "ippo_ff_mpe.yaml"),
    "mappo": ("MAPPO", "mappo_rnn_mpe", "mappo_homogenous_rnn_mpe.yaml"),
    "vdn-pqn": ("QLearning", "pqn_vdn_rnn", "alg/pqn_vdn_rnn_mpe.yaml"),
    "vdn-pqn-ff": ("QLearning", "pqn_vdn_ff", "alg/pqn_vdn_ff_mpe.yaml"),
    "qmix": ("QLearning", "qmix_rnn", "alg/ql_rnn_mpe.yaml"),
}
"""JaxMARL's, which are not in its package: folder, script and configuration below `baselines` in its repository."""
ONE_THREAD = dict.fromkeys(("NPROC", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


def python_of(peer: str) -> str | None:
    """The interpreter of a peer's environment, made if need be; None where it cannot be installed."""
    room = ROOMS / peer
    python = room / "bin" / "python"
    if python.exists():
        return str(python)
    print(f"making {room}", flush=True)
    subprocess.run([sys.executable, "-m", "venv", str(room)], check=True)
    install = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *PACKAGES[peer]]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode == 0:
        return str(python)
    shutil.rmtree(room)
    reason = (done.stderr.strip() or "no reason given").splitlines()[-1]
    print(f"{peer} cannot be installed here and is left out: {reason}", flush=True)
    return None


def jaxmarl_baseline(algorithm: str, checkout: str, steps: int) -> tuple[Any, dict[str, Any], Any]:
    """A baseline of JaxMARL as shipped but for its steps: module, configuration, and training, a function of a key."""
    import wandb
    import yaml

    folder, script, config = BASELINES[algorithm]
    place = Path(checkout) / "baselines" / folder
    sys.path.insert(0, str(place))
    module = importlib.import_module(script)
    said: dict[str, Any] = yaml.safe_load((place / "config" / config).read_text())
    said = {name: float(value) if name == "LR" else value for name, value in said.items()}
    said |= {"TOTAL_TIMESTEPS": steps, "WANDB_MODE": "disabled", "TEST_DURING_TRAINING": False}
    wandb.init(mode="disabled")
    environment = [module.env_from_config(said)[0]] if folder == "QLearning" else []
    return module, said, module.make_train(said, *environment)


class Enough(Exception):
    """All that is measured has been."""


def benchmarl_run(task: Any, algorithm: str, callback: Any, seed: int, **settings: Any) -> Any:
    """BenchMARL's experiment at its defaults but these settings, until its end or the callback's `Enough`."""
    from benchmarl import algorithms
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    config = ExperimentConfig.get_from_yaml()
    config.loggers, config.evaluation, config.render, config.create_json = [], False, False, False
    for name, value in settings.items():
        setattr(config, name, value)
    kind = {"ippo": "IppoConfig", "mappo": "MappoConfig", "qmix": "QmixConfig"}[algorithm]
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        config.save_folder = folder
        experiment = Experiment(
            task=task,
            algorithm_config=getattr(algorithms, kind).get_from_yaml(),
            model_config=MlpConfig.get_from_yaml(),
            critic_model_config=MlpConfig.get_from_yaml(),
            seed=seed,
            config=config,
            callbacks=[callback],
        )
        with contextlib.suppress(Enough):
            experiment.run()
    return experiment


class Side:
    """A program that measures on request: a line of JSON in, a line of JSON out.

    It runs `script --serve NAME` on one core, with one thread, and stays alive between turns.
    """

    def __init__(self, name: str, python: str, script: str, core: int):
        self.name = name
        command = ["taskset", "-c", str(core), python, script, "--serve", name]
        if shutil.which("taskset") is None:
            command = command[3:]
        self.process = subprocess.Popen(
            command,
            env={**os.environ, **ONE_THREAD, "XLA_FLAGS": ""},  # as XLA compiles by itself
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE if name != "ours" else None,
            text=True,
        )

    def ask(self, **request: Any) -> float | None:
        """What it measured; None, and a line that says why, if it fails."""
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
            for line in self.process.stdout:  # a peer may print on import
                if line.startswith('{"rate"'):
                    return json.loads(line)["rate"]
        except BrokenPipeError:
            pass
        said = self.process.stderr.read().strip() if self.process.stderr is not None else ""
        print(f"{self.name} failed and is left out: {(said or 'see above').splitlines()[-1]}", flush=True)
        return None

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


def serve(measure: Any) -> None:
    """The other end of `Side`: answer requests with `measure(**request)` until the input ends."""
    for line in sys.stdin:
        print(json.dumps({"rate": measure(**json.loads(line))}), flush=True)


def spread(values: Sequence[float]) -> str:
    """Median, smallest and largest."""
    return f"{statistics.median(values):.3g} ({min(values):.3g} to {max(values):.3g})"


def summary(ratios: Mapping[str, Mapping[str, Sequence[float]]]) -> dict[str, Any]:
    """What `--json` prints: {ratio: {peer: {size: median}}, spread: {peer: {size: all of them}}}."""
    medians = {peer: {k: statistics.median(v) for k, v in sizes.items() if v} for peer, sizes in ratios.items()}
    return {"ratio": medians, "spread": ratios}
