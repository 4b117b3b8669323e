"""A search on a Ray cluster: Optuna proposes, Ray Tune schedules and prunes (ASHA), each trial is a Ray task.

The truth lies in the trials' run folders, not in Tune's own files: whatever dies, the next start reads what was tried,
tells Optuna, and goes on with what was under way. All nodes must see the folder.
"""

import json
import os
import shlex
import socket
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

from gacrl.errors import UserError
from gacrl.experiments import search
from gacrl.experiments.search import PRUNED, Search, Searched, Spec
from gacrl.experiments.study import Planned, Watch, train_missing
from gacrl.report.screen import Pace
from gacrl.training import devices
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.watching import Watcher

os.environ.update(  # Ray reads them when it is imported
    RAY_USAGE_STATS_ENABLED="0",
    RAY_AIR_NEW_OUTPUT="0",
    RAY_CHDIR_TO_TRIAL_DIR="0",
    TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1",
    TUNE_DISABLE_SIGINT_HANDLER="1",
    TUNE_DISABLE_STRICT_METRIC_CHECKING="1",
    TUNE_WARN_EXCESSIVE_EXPERIMENT_CHECKPOINT_SYNC_THRESHOLD_S="0",
)
try:
    import optuna  # pyright: ignore[reportMissingImports]
    import ray  # pyright: ignore[reportMissingImports]
    from ray import tune  # pyright: ignore[reportMissingImports]
    from ray.tune.schedulers import ASHAScheduler  # pyright: ignore[reportMissingImports]
    from ray.tune.search.optuna import OptunaSearch  # pyright: ignore[reportMissingImports]
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise UserError("--ray needs Ray and Optuna: pip install 'gacrl[ray]'") from error

_REDUCTION = 3
"""Of the trials that reach a rung the best third goes on; rungs are at 1/9 and 1/3 of the planned steps."""
_REACHABLE_SECONDS = 5.0
_START_SECONDS = 45.0
"""A worker process that has not started by then never will: it takes 1 to 10 s."""
_RETRIES = 3
"""A trial whose process or node died is taken up again so often."""


def ray_search(spec: Spec, out: Path, address: str, cpus: float, gpus: float, watch: Watch) -> Search | None:
    """Train what is missing under `out` on the cluster; None where the watcher stopped it.

    address: HOST:PORT of the cluster's head, or `auto`. cpus, gpus: what a trial takes. Raises UserError.
    """
    _require_cluster(address)
    out = out.resolve()
    search.claim(spec, out, "Optuna")
    watch.planned({})
    tried = search.trials_in(spec, out)
    missing = spec.trials - sum(trial.state != "unfinished" for trial in tried)
    if missing <= 0:
        return search.conclude(spec, out)
    _connect(address)
    stopping = watch.run("search").stop
    try:
        _require_workers()
        results = _tuner(spec, out, {"cpu": cpus, "gpu": gpus}, missing, tried, watch).fit()
    finally:
        ray.shutdown()
    if stopping():
        return None
    for error in results.errors:
        watch.say(f"a trial failed {_RETRIES + 1} times: {str(error).strip().splitlines()[-1]}")
    return search.conclude(spec, out)


def _require_cluster(address: str) -> None:
    """Raises UserError where no cluster answers; Ray itself would try for minutes, and then end the process."""
    if address == "auto":
        return
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise UserError(f"--ray must be HOST:PORT of the cluster's head, or auto, not {address!r}")
    try:
        socket.create_connection((host.strip("[]"), int(port)), _REACHABLE_SECONDS).close()
    except OSError as error:
        raise UserError(
            f"no Ray cluster answers at {address} ({error}): is `ray start --head` running?"
        ) from error


def _connect(address: str) -> None:
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, RuntimeError) as error:
        first = str(error).strip().splitlines()[0]
        raise UserError(f"cannot join the Ray cluster at {address}: {first}") from error


def _require_workers() -> None:
    """Raises UserError where a node cannot start worker processes; Tune would wait for one without a word.

    Trials run in workers with an environment of their own, which Ray starts by a shell that takes their path apart.
    """
    nodes = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
    end = time.monotonic() + _START_SECONDS
    ask = ray.remote(num_cpus=0, max_retries=0)(lambda: sys.executable)  # as a lambda it needs no import of ours
    asked: list[dict[Any, str]] = [
        {
            ask.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node, soft=False), **own).remote(): node
            for node in nodes
        }
        for own in ({}, {"runtime_env": {"env_vars": {"GACRL_WORKER": "1"}}})
    ]
    for answers in asked:
        seconds = max(end - time.monotonic(), 0.0)
        there, _ = ray.wait(list(answers), num_returns=len(answers), timeout=seconds)
        alive = {node["NodeID"] for node in ray.nodes() if node["Alive"]}
        for answer, node in answers.items():
            if node in alive and answer not in there:
                raise UserError(_why_none_starts(nodes[node]))
            if node in alive:
                _require_plain(answer, nodes[node]["NodeManagerAddress"])


def _require_plain(answer: Any, node: str) -> None:
    try:
        python = ray.get(answer)
    except ray.exceptions.RayError as error:
        raise UserError(f"a worker on {node} failed: {str(error).strip().splitlines()[-1]}") from error
    if shlex.quote(python) != python:
        raise UserError(
            f"Ray cannot start trials on {node}, since the path of its Python has a space or another character that a "
            f"shell takes apart: {python}; make its environment in a folder with a plain name"
        )


def _why_none_starts(node: Mapping[str, Any]) -> str:
    """The sentence, with the last line of Ray's log where that lies on this machine."""
    log = Path(node["RayletSocketName"]).parents[1] / "logs" / "raylet.err"
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    except OSError:
        lines = []
    said = f" ({lines[-1].strip()})" if lines else ""
    return f"Ray started no worker on {node['NodeManagerAddress']} within {_START_SECONDS:.0f} s{said}: see {log} there"


class _Follower(tune.Callback, tune.Stopper):  # pyright: ignore[reportUntypedBaseClass]
    """What Tune does, told, and noted in the trials' folders; and the wish to stop."""

    def __init__(
        self, spec: Spec, out: Path, missing: int, say: Callable[[str], None], stopping: Callable[[], bool]
    ):
        """missing: trials that are still to be made."""
        self._spec, self._out, self._say, self._stopping = spec, out, say, stopping
        self._missing, self._ended, self._pace = missing, 0, Pace(missing)

    def __reduce__(self) -> Any:  # Tune writes a copy of what it was given, for a restart that is not ours
        return tune.Callback, ()

    def on_trial_result(self, iteration: int, trials: Any, trial: Any, result: dict[str, Any], **_: Any) -> None:
        name, metric = self._trial(trial).name, self._spec.metric
        self._say(f"{name}: {metric} {result[metric]:.4g} after {result['env_steps']:,} steps")

    def on_trial_complete(self, iteration: int, trials: Any, trial: Any, **_: Any) -> None:
        planned = self._trial(trial)
        if not planned.finished and not self._stopping():
            (planned.folder / PRUNED).write_text("{}\n", encoding="utf-8")
        self._ended += 1
        how, left = "done" if planned.finished else "given up", self._pace.left(self._ended)
        self._say(f"{self._ended} of {self._missing}, {planned.name}: {how}; all trials: {left}")

    def _trial(self, trial: Any) -> Planned:
        return self._spec.trial(self._out, decoded(self._spec, trial.config))

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:
        return False

    def stop_all(self) -> bool:
        return self._stopping()


def _tuner(
    spec: Spec, out: Path, resources: Mapping[str, float], missing: int, tried: list[search.Trial], watch: Watch
) -> Any:
    planned = spec.config.num_updates * spec.config.steps_per_update
    mode = "max" if spec.maximize else "min"
    follower = _Follower(spec, out, missing, watch.say, watch.run("search").stop)
    return tune.Tuner(
        tune.with_resources(
            tune.with_parameters(_train_trial, spec=spec, out=out, cpus=resources["cpu"]), dict(resources)
        ),
        tune_config=tune.TuneConfig(
            search_alg=_proposer(spec, mode, tried),
            scheduler=ASHAScheduler(
                time_attr="env_steps",
                metric=spec.metric,
                mode=mode,
                max_t=planned,
                grace_period=max(planned // _REDUCTION**2, 1),
                reduction_factor=_REDUCTION,
            ),
            num_samples=missing,
        ),
        run_config=tune.RunConfig(
            storage_path=str(out / "ray"),
            callbacks=[follower],
            stop=follower,
            failure_config=tune.FailureConfig(max_failures=_RETRIES),
            verbose=0,
        ),
    )


def _proposer(spec: Spec, mode: str, tried: list[search.Trial]) -> Any:
    """Optuna, told of what was tried; what was under way comes first."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    proposer = OptunaSearch(
        space={one.setting: _distribution(one) for one in spec.searched},
        metric=spec.metric,
        mode=mode,
        sampler=optuna.samplers.TPESampler(seed=spec.config.seed + len(tried)),  # else it proposes the same again
        points_to_evaluate=[encoded(spec, trial.values) for trial in tried if trial.state == "unfinished"] or None,
    )
    for trial in tried:
        if trial.state != "unfinished":
            proposer.add_evaluated_point(encoded(spec, trial.values), trial.value, error=trial.value is None)
    return proposer


def _distribution(one: Searched) -> Any:
    kinds = optuna.distributions
    if one.kind == "choice":
        return kinds.CategoricalDistribution([json.dumps(value) for value in one.values])
    if one.kind == "integer":
        return kinds.IntDistribution(*one.values)
    return kinds.FloatDistribution(*map(float, one.values), log=one.kind == "log")


def encoded(spec: Spec, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values as Optuna has them: its choices are texts, whatever they stand for."""
    choices = {one.setting for one in spec.searched if one.kind == "choice"}
    return {name: json.dumps(value) if name in choices else value for name, value in values.items()}


def decoded(spec: Spec, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return Optuna's values as they stand in settings."""
    choices = {one.setting for one in spec.searched if one.kind == "choice"}
    return {name: json.loads(value) if name in choices else value for name, value in values.items()}


def _train_trial(config: dict[str, Any], spec: Spec, out: Path, cpus: float) -> None:
    """One trial, on whichever node: from its last checkpoint, where it has one."""
    devices.prepare_jax(min(spec.config.num_seeds, max(int(cpus), 1)))
    planned = spec.trial(out, decoded(spec, config))
    planned.folder.parent.mkdir(parents=True, exist_ok=True)

    def progress(progress: Progress) -> None:
        if not progress.done:  # the last one is reported when nothing is left to be pruned away
            tune.report({spec.metric: search.mean_value(spec, progress.rows), "env_steps": progress.env_steps})

    # Whoever worked on it before may have been killed this very moment; and chance may propose a trial twice.
    with FileLock(planned.folder.with_suffix(".lock")):
        train_missing([planned], Watch(run=lambda name: Watcher(progress=progress)))
    value, env_steps = search.value_of(spec, RunFolder(planned.folder))
    if value is not None:
        tune.report({spec.metric: value, "env_steps": env_steps})
