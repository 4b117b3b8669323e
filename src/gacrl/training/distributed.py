"""Training by several processes, on one host or on many, as one program: `jax.distributed`.

Every process runs the same command. Seeds, or the environments of PPO, are spread over the devices of all of them
(`training.devices`); process 0 alone writes the run folder.
"""

import os
import time
import traceback
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace

import jax

from gacrl.config.run import RunConfig
from gacrl.errors import UserError
from gacrl.training.build import Plan
from gacrl.training.devices import wait_for_all
from gacrl.training.peers import Peers, Place, meet
from gacrl.training.recorder import RunFolder, resuming
from gacrl.training.watching import Watcher
from gacrl.versions import version

ALONE = Place(0, 1, "", 0)

_VERDICT_SECONDS = 3.0
"""A peer that dies shows itself also as a computation that fails here; this long the better explanation may take."""


def find_place(
    coordinator: str | None = None, num_processes: int | None = None, process_id: int | None = None
) -> Place:
    """Find which process this is: from what is given, else JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and
    JAX_PROCESS_ID, else what SLURM, Open MPI, Kubernetes or a TPU pod say. Raises UserError.
    """
    coordinator = coordinator or os.environ.get("JAX_COORDINATOR_ADDRESS")
    count = _number("JAX_NUM_PROCESSES") if num_processes is None else num_processes
    process = _number("JAX_PROCESS_ID") if process_id is None else process_id
    local_devices = None
    if coordinator is None or count is None or process is None:
        from jax._src import clusters  # JAX has no public way to ask where it runs without starting

        coordinator, count, process, local_devices = clusters.ClusterEnv.auto_detect_unset_distributed_params(
            coordinator, count, process, None, None, 60
        )
    if coordinator is None or count is None or process is None:
        raise UserError(
            "no cluster is found here: give --coordinator HOST:PORT, --num-processes and --process-id, or set "
            "JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID"
        )
    host, _, port = coordinator.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65_536:
        raise UserError(f"the coordinator must be HOST:PORT, not {coordinator!r}")
    if count < 1:
        raise UserError(f"--num-processes must be at least 1, not {count}")
    if not 0 <= process < count:
        raise UserError(f"--process-id must be between 0 and {count - 1} of {count} processes, not {process}")
    return Place(
        process, count, host.strip("[]"), int(port), None if local_devices is None else tuple(local_devices)
    )


def _number(name: str) -> int | None:
    text = os.environ.get(name)
    if text is None:
        return None
    if not text.isdigit():
        raise UserError(f"{name} must be a whole number, not {text!r}")
    return int(text)


@contextmanager
def joined(place: Place, settings: str, seconds: float, watcher: Watcher) -> Generator[Watcher]:
    """Be one of several processes for as long as this lasts; what goes wrong in one of them ends all.

    settings: what must be the same in all of them. seconds: how long to wait for the others. Gives the watcher to run
    with. An error does not come out of here: it is printed, the others are told, and the process ends, since JAX
    would wait for them.
    """
    if place.count == 1:
        yield watcher
        return
    peers = meet(place, f"{version()} {jax.__version__} {settings}", seconds)
    try:
        jax.config.update("jax_enable_preemption_service", False)  # it would keep SIGTERM from us
        jax.distributed.initialize(
            peers.coordinator,
            place.count,
            place.process,
            local_device_ids=place.local_devices,
            cluster_detection_method="deactivate",
            initialization_timeout=int(seconds),
        )
        wait_for_all()
        yield replace(watcher, planned=lambda *planned: _planned(peers, watcher, *planned))
        peers.leave()
        jax.distributed.shutdown()
    except UserError as error:
        peers.end(str(error), 2)
    except KeyboardInterrupt:
        peers.end(f"process {place.process} was interrupted", 130)
    except BaseException as error:
        time.sleep(_VERDICT_SECONDS)
        traceback.print_exc()
        peers.end(f"process {place.process} failed: {type(error).__name__}", 1)


def _planned(peers: Peers, watcher: Watcher, folder: RunFolder, config: RunConfig, plan: Plan) -> None:
    if peers.place.process == 0:
        peers.mend = lambda: _mend(folder)
        peers.tell(f"go on with `{resuming(folder.path)}`")
    watcher.planned(folder, config, plan)


def _mend(folder: RunFolder) -> str:
    """Names the last checkpoint; whether it is whole is seen when it is read."""
    found = sorted(folder.checkpoints.glob("step-*"))
    last = f"the last checkpoint is {found[-1]}" if found else "there is no checkpoint yet"
    return f"{last}; go on with `{resuming(folder.path)}`"
