"""Follow a training from your own code: every evaluation becomes a line of a CSV file, and a plateau ends the run.

python examples/own_tracker.py
"""

import csv
from dataclasses import replace
from pathlib import Path

import gacrl


class Tracker:
    """Writes what each evaluation reached, and asks to stop when three in a row bring nothing new."""

    def __init__(self, path):
        self.path, self.best, self.since = Path(path), float("-inf"), 0

    def progress(self, progress):
        """One evaluation: a row for each seed, as in metrics.jsonl."""
        for row in progress.rows:
            told = {"seed": row["seed"], "env_steps": row["env_steps"], **row["greedy"]}
            new = not self.path.exists()
            with self.path.open("a", newline="", encoding="utf-8") as file:
                writer = csv.DictWriter(file, told)
                if new:
                    writer.writeheader()
                writer.writerow(told)
        reached = sum(row["greedy"]["return_agent_mean"] for row in progress.rows) / len(progress.rows)
        self.since = 0 if reached > self.best else self.since + 1
        self.best = max(self.best, reached)

    def watcher(self):
        """The functions that training calls."""
        return gacrl.Watcher(progress=self.progress, stop=lambda: self.since >= 3)


def main(path="progress.csv", env_steps=30_000, out=None):
    """Train the default preset on the task of examples/own_task.py under this tracker."""
    config = gacrl.preset("gacrl")
    config = replace(
        config,
        training=replace(config.training, env_steps=env_steps),
        evaluation=replace(config.evaluation, interval=max(env_steps // 12, 1)),
    )
    return gacrl.train(config, env="examples/own_task.py:Beacon", watcher=Tracker(path).watcher(), out=out)


if __name__ == "__main__":
    run = main()
    print(f"stopped after {run.env_steps:,} environment steps; {run.folder}")
