"""What the terminal shows: a header, a live line (or a line per evaluation), and tables at the end."""

import sys
import time
from types import TracebackType
from typing import Any

from rich import box
from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from gacrl import tasks
from gacrl.config.run import RunConfig
from gacrl.training.build import Plan
from gacrl.training.diagnosis import Diagnosis
from gacrl.training.footprint import readable
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder
from gacrl.training.session import Ended
from gacrl.training.watching import Watcher


class TerminalWatcher:
    """Follows a run. On a terminal the line lives, also while things compile; elsewhere it is a line each.

    quiet: say nothing; another process does.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self._console = _console(quiet)
        self._alive = self._console.is_terminal
        self._line = _Line()
        self._live = Live(self._line, console=self._console, refresh_per_second=8, transient=True)
        self._stop = False
        self.exit_code = 130
        """What an early stop returns to the shell."""

    def __enter__(self) -> "TerminalWatcher":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def request_stop(self, exit_code: int) -> None:
        """End the run at the next checkpoint."""
        self._stop, self.exit_code = True, exit_code
        self._say("stopping after the evaluation under way; once more to stop at once")

    def watcher(self) -> Watcher:
        """The functions that a session calls."""
        return Watcher(
            planned=self._planned,
            compiling=lambda: self._say("compiling the training program"),
            progress=self._progress,
            finishing=lambda: self._say("closing evaluation, episodes and GIF"),
            warn=lambda sentence: print(f"gacrl: {sentence}", file=sys.stderr),
            stop=lambda: self._stop,
        )

    def _planned(self, folder: RunFolder, config: RunConfig, plan: Plan) -> None:
        say = self._print
        seeds = ", ".join(str(seed) for seed in config.seeds)
        say(f"run        {folder.path}")
        say(f"task       {config.task}: {plan.num_agents} agents, episodes of {plan.max_cycles} steps")
        say(f"preset     {config.preset} ({config.algorithm.name}), {plan.parameters:,} parameters")
        say(f"seeds      {seeds} on {', '.join(plan.devices)}")
        say(
            f"steps      {config.num_updates * config.steps_per_update:,} per seed, "
            f"{config.num_updates:,} updates, an evaluation every "
            f"{config.updates_per_chunk * config.steps_per_update:,} steps"
        )
        state = readable(plan.bytes_per_seed * config.num_seeds)
        say(f"memory     {state} for the training state; {readable(plan.bytes_needed)} in all, at the least")
        for note in plan.notes:
            say(f"note       {note}")
        if self._alive:
            self._live.start()

    def _say(self, what: str) -> None:
        if self._alive:
            self._line.text = what
        else:
            self._print(what)

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True)  # a path is to be copied: no line breaks in it

    def _progress(self, progress: Progress) -> None:
        line = describe(progress, progress.rows[0]["episodes_done"])
        if self._alive:
            self._line.text = line
            self._line.fraction = progress.env_steps / progress.total_env_steps
        else:
            self._print(line)

    def report(self, run: Ended) -> None:
        """The end: what was reached, the paper's tables where they apply, and where everything lies."""
        self._live.stop()
        if self.quiet:
            return
        say = self._print
        if run.summary is None:
            again = f"gacrl resume {run.folder}{tasks.flag(run.config.task)}"
            say(f"stopped at environment step {run.env_steps:,}; go on with: {again}")
            return
        print_evaluation({"run": str(run.folder), **run.summary}, self._console)
        self._paper_tables(run)
        summary = run.summary
        say(
            f"{summary['steps_per_second']:,.0f} training steps/s, {summary['compile_seconds']:.1f} s compiling, "
            f"{summary['wall_seconds']:.1f} s in all"
        )
        say(f"summary    {run.folder / 'summary.json'}")
        picture = run.folder / "episodes.gif"
        if picture.is_file():
            say(f"episodes   {picture}")
        else:
            say(
                f"episodes   {run.folder / 'episodes'}; no picture: {run.config.task} does not say where things are"
            )

    def _paper_tables(self, run: Ended) -> None:
        from gacrl.experiments.paper import tables as paper_tables

        if not paper_tables.apply_to(run.config):
            return
        with self._console.status("playing policies that learn nothing at the difficulty of each row"):
            metrics = RunFolder(run.folder).metrics()
            tables = {
                paper_tables.printed()[name]["caption"]: rows(run.config, metrics)
                for name, rows in (("table_2", paper_tables.table_2), ("table_3", paper_tables.table_3))
            }
        for caption, rows in tables.items():
            if not rows:
                continue
            table = Table(
                "episode",
                "who",
                *paper_tables.COLUMNS.values(),
                title=caption,
                title_justify="left",
                box=box.SIMPLE_HEAD,
            )
            for row in rows:
                cells = [
                    _cell(row.mean.get(name), row.sd.get(name) if row.sd else None)
                    for name in paper_tables.COLUMNS
                ]
                end = row.who == paper_tables.SCRIPTED[-1]
                table.add_row(str(row.episode), row.who, *cells, end_section=end)
            self._console.print(table)


class RunsWatcher:
    """Follows several runs, one after the other: a live table of them on a terminal, elsewhere lines."""

    def __init__(self) -> None:
        self._console = _console()
        self._alive = self._console.is_terminal
        self._standing: dict[str, _Line | str] = {}
        self._note: _Line | None = None
        self._live = Live(
            console=self._console, get_renderable=self._table, refresh_per_second=8, transient=not self._alive
        )
        self._stop = False
        self.exit_code = 130
        """What an early stop returns to the shell."""

    def __enter__(self) -> "RunsWatcher":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._note = None  # what is going on is over; the table of the runs stays
        self._live.stop()

    def request_stop(self, exit_code: int) -> None:
        """End the run under way at its next checkpoint, and begin no other."""
        self._stop, self.exit_code = True, exit_code
        self.say("stopping after the evaluation under way; once more to stop at once")

    def planned(self, names: list[str]) -> None:
        """These runs are going to be made."""
        self._standing = dict.fromkeys(names, "waiting")
        if self._alive:
            self._live.start()

    def finished(self, name: str, how: str) -> None:
        """That run has come to its end, in one way or another."""
        before = self._standing[name]
        took = f", {before.seconds:.0f} s" if isinstance(before, _Line) else ""
        self._standing[name] = how + took
        if not self._alive:
            self._print(f"{name}: {self._standing[name]}")

    def say(self, sentence: str) -> None:
        """Something that belongs to no run."""
        self._note = _Line()
        self._note.text = sentence
        if not self._alive:
            self._print(sentence)

    def watcher(self, name: str) -> Watcher:
        """The functions that the session of that run calls."""
        line = self._standing[name] = _Line()

        def tell(what: str) -> None:
            line.text = what
            if not self._alive:
                self._print(f"{name}: {what}")

        def progress(progress: Progress) -> None:
            line.fraction = progress.env_steps / progress.total_env_steps
            tell(describe(progress, progress.rows[0]["episodes_done"]))

        return Watcher(
            compiling=lambda: tell("compiling the training program"),
            progress=progress,
            finishing=lambda: tell("closing evaluation, episodes and GIF"),
            warn=lambda sentence: print(f"gacrl: {sentence}", file=sys.stderr),
            stop=lambda: self._stop,
        )

    def _print(self, line: str) -> None:
        self._console.print(line, soft_wrap=True)

    def _table(self) -> Table:
        table = Table.grid(padding=(0, 2))
        for name, standing in self._standing.items():
            table.add_row(name, standing)
        if self._note is not None:
            table.add_row("", self._note)
        return table


def _console(quiet: bool = False) -> Console:
    """Colours and the terminal's width on a terminal; elsewhere lines that a log can hold."""
    console = Console(highlight=False, markup=False, emoji=False, quiet=quiet)
    if not console.is_terminal:
        console.width = 130
    return console


class _Line:
    """The live line: a spinner, how far, what is going on, and for how long already."""

    def __init__(self) -> None:
        self.text = "starting"
        self.fraction = 0.0
        self._spinner = Spinner("dots")
        self._begun = time.monotonic()

    @property
    def seconds(self) -> float:
        """Since it began."""
        return time.monotonic() - self._begun

    def __rich__(self) -> Text:
        full = round(20 * self.fraction)
        bar = "━" * full + "╌" * (20 - full)
        line = Text(f" {bar} {self.text}  [{self.seconds:.0f} s]")
        spinning = self._spinner.render(time.monotonic())
        return Text.assemble(spinning, line) if isinstance(spinning, Text) else line


_ON_A_LINE = 3
"""Metrics of the progress line."""


def describe(progress: Progress, episode: int) -> str:
    """One line on where a run stands: what its greedy evaluation reached, the mean over the seeds."""

    def mean(name: str) -> str:
        return f"{sum(row['greedy'][name] for row in progress.rows) / len(progress.rows):.2f}"

    reached = "  ".join(f"{label} {mean(name)}" for name, label in list(progress.shown.items())[:_ON_A_LINE])
    return (
        f"episode {episode:,}  {progress.clock.steps_per_second:,.0f} steps/s  {reached}  "
        f"left {_duration(progress.seconds_left)}"
    )


def print_evaluation(scores: dict[str, Any], console: Console | None = None) -> None:
    """A table of the task's metrics: the policy, and those that learn nothing, on the same starts."""
    console = _console() if console is None else console
    shown: dict[str, str] = scores["task"]["shown"]
    title = f"{scores['run']}: {scores['episodes']} episodes of {scores['horizon']} steps"
    if any(metrics[next(iter(shown))]["interval"] for metrics in scores["final"].values()):
        title += "; mean over seeds ± half the 95 % interval"
    table = Table("", *shown.values(), title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for kind, metrics in scores["final"].items():
        cells: list[str] = []
        for name in shown:
            entry = metrics.get(name)
            interval = entry and entry["interval"]
            half_width = (interval[1] - interval[0]) / 2 if interval else None
            cells.append(_cell(entry and entry["mean"], half_width, 3))
        table.add_row(kind, *cells)
    table.add_section()
    for who, metrics in scores["references"].items():
        table.add_row(who, *[_cell(metrics.get(name), None, 3) for name in shown])
    console.print(table)
    worth = scores["final"]["greedy"].get("score_talk")
    if worth is not None:
        talk = scores["task"]["talk"]
        console.print(
            f"talk       {worth['mean']:.2f} of the way from the best silent policy, {talk['silent']:.2f}, "
            f"to one that is told everything, {talk['told']:.2f}",
            soft_wrap=True,
        )
    if "messages" in scores:
        bits = scores["messages"]
        console.print(
            f"messages   {bits['bits_sent']:.2f} bits an agent and step; "
            f"{bits['bits_used_last_round']:.2f} in the last round's symbol, by how often each is sent"
        )


def print_diagnosis(found: Diagnosis) -> None:
    """The first bad update beside the one before it, and everything that is not finite after it."""
    console, bad = _console(), found.bad
    if bad is None:
        console.print(f"every update from environment step {found.begun_at} to {found.ended_at} is finite")
        return
    console.print(
        f"seed {bad.seed}: update {bad.update}, up to environment step {bad.env_steps}, is the first bad one",
        soft_wrap=True,
    )
    table = Table("", "before", "then", box=box.SIMPLE_HEAD)
    for name, (before, then) in bad.metrics.items():
        table.add_row(name, "" if before is None else f"{before:.6g}", f"{then:.6g}")
    console.print(table)
    for name, value in bad.broken.items():
        console.print(f"not finite {name}: {value}", soft_wrap=True)


def _cell(mean: float | None, sd: float | None = None, digits: int = 2) -> str:
    if mean is None:
        return ""
    return f"{mean:.{digits}f}" + (f" ± {sd:.{digits}f}" if sd is not None else "")


def _duration(seconds: float) -> str:
    if seconds != seconds:  # not known yet
        return "?"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
