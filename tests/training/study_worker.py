"""Runs begun, stopped and gone on with in one process, as a study does, for some seconds: MiB resident and files open.

    python study_worker.py FOLDER SECONDS

A process of its own, since the checks of shapes that tests run under remember every function that they have seen.
"""

import gc
import itertools
import resource
import shutil
import sys
import time
from pathlib import Path

from test_soak import config

from gacrl.experiments.study import Planned, Watch, train_missing
from gacrl.training.watching import Watcher

folder, end = Path(sys.argv[1]), time.monotonic() + float(sys.argv[2])
for turn in itertools.count(1):
    asked = itertools.count(1)
    planned = [Planned("run", config(env_steps=160), folder)]
    third_time = Watcher(stop=lambda asked=asked: next(asked) == 3)
    assert not train_missing(planned, Watch(run=lambda name, watcher=third_time: watcher))
    assert train_missing(planned, Watch())
    shutil.rmtree(folder)
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    print(pages * resource.getpagesize() // 2**20, len(list(Path("/proc/self/fd").iterdir())), flush=True)
    if time.monotonic() > end and turn >= 6:
        break
