"""What the terminal shows: a header, a live line (or a line per evaluation), and tables at the end."""

import math
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner
from rich.text import Text

from gacrl.cli import stopwatch
from gacrl.config.presets import label
from gacrl.config.run import RunConfig
from gacrl.report.screen import Pace, console, duration, say
from gacrl.report.tables import print_table
from gacrl.training.build import Plan
from gacrl.training.diagnosis import Diagnosis
from gacrl.training.footprint import readable
from gacrl.training.loop import Progress
from gacrl.training.recorder import RunFolder, resuming
from gacrl.training.session import Ended
from gacrl.training.telling import reached, standing
from gacrl.training.watching import Watcher

if TYPE_CHECKING:
    from gacrl.doctor import Check, Finding


Watching = TypeVar("Watching", bound="LiveWatcher")


class LiveWatcher(ABC):
    """Owns the live line of a terminal, and the stop that a user asks for.

    quiet: say nothing; another process does.
    """

    def __init__(self, quiet: bool = False) -> None:
        self.quiet = quiet
        self._console = console(quiet)
        self._alive = self._console.is_terminal
        self._line = _Line()
        self._live = Live(self._line, console=self._console, refresh_per_second=8, transient=True)
        self._stop = False
        self.exit_code = 130
        """What an early stop returns to the shell."""

    def __enter__(self: Watching) -> Watching:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()

    def request_stop(self, exit_code: int) -> None:
        """End the run under way at its next checkpoint, and begin no other."""
        self._stop, self.exit_code = True, exit_code
        self.say("stopping after the evaluation under way; once more to stop at once")

    @abstractmethod
    def say(self, sentence: str) -> None:
        """Show what goes on."""

    def _print(self, line: str) -> None:
        say(self._console, line)


class TerminalWatcher(LiveWatcher):
    """Follows a run. On a terminal the line lives, also while things compile; elsewhere it is a line each."""

    def watcher(self) -> Watcher:
        """Return the functions that a session calls."""
        return Watcher(
            planned=self._planned,
            compiling=lambda: self.say("compiling the training program"),
            progress=self._progress,
            finishing=lambda: self.say("closing evaluation, episodes and GIF"),
            warn=lambda sentence: print(f"gacrl: {sentence}", file=sys.stderr),
            stop=lambda: self._stop,
        )

    def _planned(self, folder: RunFolder, config: RunConfig, plan: Plan) -> None:
        name, seeds = label(config), ", ".join(str(seed) for seed in config.seeds)
        origin = "" if name == config.preset else f", with other settings as the preset {config.preset}"
        self._print_whole(f"run        {folder.path}")
        self._print(f"task       {config.task}: {plan.num_agents} agents, episodes of {plan.max_cycles} steps")
        self._print(f"preset     {name} ({config.algorithm.name}{origin}), {plan.parameters:,} parameters")
        self._print(f"seeds      {seeds} on {', '.join(plan.devices)}")
        self._print(
            f"steps      {config.num_updates * config.steps_per_update:,} per seed, "
            f"{config.num_updates:,} updates, an evaluation every "
            f"{config.updates_per_chunk * config.steps_per_update:,} steps"
        )
        state = readable(plan.bytes_per_seed * config.num_seeds)
        self._print(
            f"memory     {state} for the training state; {readable(plan.bytes_needed)} in all, at the least"
        )
        for note in plan.notes:
            self._print(f"note       {note}")
        if self._alive:
            self._live.start()

    def say(self, sentence: str) -> None:
        """Show what goes on: on the live line where there is one."""
        if self._alive:
            self._line.text = sentence
        else:
            self._print(sentence)

    def note(self, line: str) -> None:
        """Print a line that belongs to the run, from any thread."""
        self._print_whole(line)

    def _print_whole(self, line: str) -> None:
        """For a line with a path, which is to be copied: there are no line breaks in it."""
        self._console.print(line, soft_wrap=True)

    def _progress(self, progress: Progress) -> None:
        """A line for each evaluation stays; the live line says what goes on."""
        self._print(standing(progress))
        self._line.text = f"training, {duration(progress.seconds_left)} left"
        self._line.fraction = progress.env_steps / progress.total_env_steps

    def report(self, run: Ended) -> None:
        """Print the end: what was reached, the paper's tables where they apply, and where everything lies."""
        self._live.stop()
        if self.quiet:
            return
        if run.summary is None:
            again = resuming(run.folder, run.config.task)
            self._print_whole(f"stopped at environment step {run.env_steps:,}; go on with: {again}")
            return
        print_evaluation({"run": str(run.folder), **run.summary}, self._console)
        self._paper_tables(run)
        self._print(
            f"pace       {run.summary['steps_per_second']:,.0f} training steps/s, "
            f"{run.summary['compile_seconds']:.1f} s compiling"
        )
        self._print_whole(f"summary    {run.folder / 'summary.json'}")
        picture = run.folder / "episodes.gif"
        if picture.is_file():
            self._print_whole(f"episodes   {picture}")
        else:
            self._print_whole(
                f"episodes   {run.folder / 'episodes'}; no picture: {run.config.task} does not say where things are"
            )
        self._print(f"time       {stopwatch.seconds():.1f} s in all, from the command to this line")

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
            cells = [
                [
                    str(row.episode),
                    row.who,
                    *(
                        _cell(row.mean.get(name), row.sd.get(name) if row.sd else None)
                        for name in paper_tables.COLUMNS
                    ),
                ]
                for row in rows
            ]
            ends = [number for number, row in enumerate(rows) if row.who == paper_tables.SCRIPTED[-1]]
            columns = ("episode", "who", *paper_tables.COLUMNS.values())
            if cells:
                print_table(self._console, columns, cells, caption, keys=2, sections=ends)
        if any(tables.values()):
            self._print(paper_tables.MEANING)


class RunsWatcher(LiveWatcher):
    """Follows several runs, one after the other: how far each is, which of how many it is, and how long all will take.

    Lines of one run that come soon after each other are left out. On a terminal a live line says more.
    """

    def __init__(self) -> None:
        super().__init__()
        self._names: dict[str, str] = {}
        self._over: set[str] = set()
        self._seconds: list[float] = []
        self._printed = -math.inf

    def planned(self, runs: Mapping[str, str]) -> None:
        """Take note of the runs that are going to be made, and of what each is."""
        self._names = dict(runs)
        if self._alive:
            self._live.start()

    def finished(self, name: str, how: str) -> None:
        """Take note that a run has come to its end, in one way or another."""
        self._over.add(name)
        told = f"{self._place(name)}{name}: {how}"
        if self._line.name == name:
            self._seconds.append(self._line.seconds)
            told += f" in {duration(self._line.seconds)}" + (
                f", {self._line.reached}" if self._line.reached else ""
            )
        more = self._seconds and len(self._over) < len(self._names)
        self._print(f"{told}; {self._left()}" if more else told)

    def say(self, sentence: str) -> None:
        """Print something that belongs to no run."""
        self._line.text = sentence
        self._print(sentence)

    def watcher(self, name: str) -> Watcher:
        """Return the functions that the session of that run calls."""
        line = self._line = _Line(name)
        self._live.update(line)
        self._printed = -math.inf
        if self._names.get(name):
            self._print(f"{self._place(name)}{name}: {self._names[name]}")

        def tell(how: str) -> None:
            line.text = f"{self._place(name)}{name}: {how}"
            if not self._alive:
                self._print(line.text)

        def progress(progress: Progress) -> None:
            line.fraction, line.reached = progress.env_steps / progress.total_env_steps, reached(progress)
            line.text = f"{self._place(name)}{name}: {standing(progress)}; {self._left(progress.seconds_left)}"
            if time.monotonic() >= self._printed + _SECONDS_BETWEEN_LINES:
                self._print(line.text)
                self._printed = time.monotonic()

        return Watcher(
            compiling=lambda: tell("compiling the training program"),
            progress=progress,
            finishing=lambda: tell("closing evaluation, episodes and GIF"),
            warn=lambda sentence: print(f"gacrl: {sentence}", file=sys.stderr),
            stop=lambda: self._stop,
        )

    def _place(self, name: str) -> str:
        """Which of how many it is."""
        return f"{list(self._names).index(name) + 1} of {len(self._names)}, " if name in self._names else ""

    def _left(self, of_this: float | None = None) -> str:
        """How long all runs will take. of_this: seconds that the one under way will; None where none is."""
        under_way = [] if of_this is None else [self._line.seconds + of_this]
        took = [*self._seconds, *under_way]
        waiting = max(len(self._names) - len(self._over) - len(under_way), 0)
        return f"all runs: {duration((of_this or 0.0) + waiting * sum(took) / len(took))} left"


class _Line:
    """The live line: a spinner, how far, what is going on, and for how long already."""

    def __init__(self, name: str = "") -> None:
        self.name, self.text, self.reached = name, "starting", ""
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


_SECONDS_BETWEEN_LINES = 10.0
"""Of the progress lines of one run among several."""


def print_evaluation(scores: dict[str, Any], screen: Console | None = None) -> None:
    """Print a table of the task's metrics: the policy, and those that learn nothing, on the same starts."""
    screen = console() if screen is None else screen
    shown: dict[str, str] = scores["task"]["shown"]
    title = f"{scores['run']}: {scores['episodes']} episodes of {scores['horizon']} steps"
    title += f"; {scores['intervention']}" if "intervention" in scores else ""
    if any(metrics[next(iter(shown))]["interval"] for metrics in scores["final"].values()):
        title += "; mean over seeds ± half the 95 % interval"
    rows: list[list[str]] = []
    for kind, metrics in scores["final"].items():
        entries = [metrics.get(name) for name in shown]
        rows.append([kind, *(_cell(entry and entry["mean"], _half_width(entry), 3) for entry in entries)])
    for who, metrics in scores["references"].items():
        rows.append([who, *[_cell(metrics.get(name), None, 3) for name in shown]])
    print_table(screen, ("", *shown.values()), rows, title, sections=[len(scores["final"]) - 1])
    worth = scores["final"]["greedy"].get("score_talk")
    if worth is not None:
        talk = scores["task"]["talk"]
        say(
            screen,
            f"talk       {worth['mean']:.2f} of the way from the best silent policy, {talk['silent']:.2f}, "
            f"to one that is told everything, {talk['told']:.2f}",
        )
    if "messages" in scores:
        bits = scores["messages"]
        sentence = (
            f"messages   an agent sends {bits['bits_sent']:.0f} bits in a step, all rounds and turned worlds together; "
            f"a symbol of the last round tells {bits['bits_used_last_round']:.2f} bits (0: it is always the same one)"
        )
        say(screen, sentence)


def _half_width(entry: dict[str, Any] | None) -> float | None:
    """Half of a metric's interval, where there is one."""
    interval = None if entry is None else entry["interval"]
    return (interval[1] - interval[0]) / 2 if interval else None


def print_examination(checks: "Sequence[Check]") -> "list[Finding]":
    """Look at one thing after the other and print what is found: which of how many, and the time that is left."""
    screen, findings = console(), []
    done, pace = 0.0, Pace(sum(check.work for check in checks))
    with screen.status("") as status:
        for number, check in enumerate(checks, 1):
            place, left = f"{number:2} of {len(checks)}", pace.left(done)
            status.update(f"{place}, {check.what}" + (f": {left} for all" if left else ""))
            found = list(check.look())
            done += check.work
            left = f" ({pace.left(done)})" if done and number < len(checks) else ""
            for finding in found:
                line = f"{'ok ' if finding.good else 'BAD'} {place}  {finding.what}: {finding.detail}"
                say(screen, line + left * (finding is found[-1]))
            findings += found
    return findings


def print_diagnosis(found: Diagnosis) -> None:
    """Print the first bad update beside the one before it, and everything that is not finite after it."""
    screen, bad = console(), found.bad
    if bad is None:
        screen.print(f"every update from environment step {found.begun_at} to {found.ended_at} is finite")
        return
    screen.print(
        f"seed {bad.seed}: update {bad.update}, up to environment step {bad.env_steps}, is the first bad one",
        soft_wrap=True,
    )
    rows = [
        [name, "" if before is None else f"{before:.6g}", f"{then:.6g}"]
        for name, (before, then) in bad.metrics.items()
    ]
    print_table(screen, ("", "before", "then"), rows)
    for name, value in bad.broken.items():
        screen.print(f"not finite {name}: {value}", soft_wrap=True)


def _cell(mean: float | None, sd: float | None = None, digits: int = 2) -> str:
    if mean is None:
        return ""
    return f"{mean:.{digits}f}" + (f" ± {sd:.{digits}f}" if sd is not None else "")
