"""Make a policy that comes along out of one seed of a run: its last checkpoint, without what only learning needs.

    python benchmarks/ship.py runs/gacrl gacrl --seed 0
    gacrl evaluate pretrained:gacrl

Writes src/gacrl/pretrained/NAME anew.
"""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import jax

from gacrl.config import files
from gacrl.training import build, checkpoint, session
from gacrl.training.keeper import Acting

SHIPPED = Path(__file__).parents[1] / "src" / "gacrl" / "pretrained"


def main() -> None:
    """Write src/gacrl/pretrained/NAME anew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("name")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    config = files.load(asked.run / "config.json")
    found, warnings = checkpoint.newest(asked.run / "checkpoints")
    assert not warnings, warnings
    learners = session.load_learners(found, build.make_trainer(config))
    at = config.seeds.index(asked.seed)
    learner = jax.tree.map(lambda leaf: leaf[at : at + 1], learners)
    alone = replace(config, seed=asked.seed, num_seeds=1)
    folder = SHIPPED / asked.name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "config.json").write_text(json.dumps(files.to_dict(alone), indent=2) + "\n", encoding="utf-8")
    tensors = checkpoint.serialise(checkpoint.arrays(Acting(learner)))
    print(checkpoint.save(folder / "checkpoints", tensors, found.env_steps, files.fingerprint(alone), {}))


if __name__ == "__main__":
    main()
