"""What each command understands, as dataclasses; their docstrings are the help."""

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gacrl import tasks
from gacrl.config import presets
from gacrl.config.run import RunConfig
from gacrl.errors import UserError

HOST, PORT = "127.0.0.1", 8642
"""Where a page is found unless something else is asked for."""


@dataclass(frozen=True)
class Cluster:
    """Several processes as one: each is started with the same command."""

    distributed: bool = False
    """Be one of several processes (docs/guides/cluster.md). The cluster says which, or the three flags below do."""
    coordinator: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """Where process 0 is, with --distributed."""
    num_processes: int | None = None
    """How many there are."""
    process_id: int | None = None
    """Which of them this is, from 0."""
    wait: float = 120.0
    """Seconds to wait for the others."""

    def check(self) -> None:
        """Raise UserError where half of it is said."""
        given = [self.coordinator, self.num_processes, self.process_id]
        if not self.distributed and given != [None] * 3:
            raise UserError("--coordinator, --num-processes and --process-id need --distributed")
        if self.wait < 1:
            raise UserError(f"--wait must be at least 1 second, not {self.wait:g}")


@dataclass(frozen=True)
class Outside:
    """What does not come with the package; both are taken before anything else is understood."""

    env: Annotated[str | None, tyro.conf.arg(metavar="TASK")] = None
    """The task: a name (`gacrl tasks`), pettingzoo:MODULE, jaxmarl:NAME, or FILE.py:NAME, which is a Task or an
    Environment; that file is run."""
    use: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="FILE")] = ()
    """A Python file to run first: it adds messages, exploration rules or algorithms (examples/)."""


@dataclass(frozen=True)
class Messages:
    """What happens to the policy's messages on their way: at most one of these. Scripted policies say nothing."""

    silence: Annotated[tuple[int, ...] | None, tyro.conf.arg(metavar="[AGENT …]")] = None
    """Nobody hears these agents, counted from 0; without a number, nobody hears anybody."""
    scramble: bool = False
    """Every agent is heard with its words from another of the episodes: as many, and about nothing that goes on."""
    drop: Annotated[float | None, tyro.conf.arg(metavar="P")] = None
    """Each edge loses its messages in a step with this probability."""
    delay: Annotated[int | None, tyro.conf.arg(metavar="K")] = None
    """Words arrive this many steps late; in an episode's first steps nothing arrives."""

    def words(self) -> str:
        """Write it as the setting `training.intervention`; nothing where no flag is given.

        Raises UserError where there are several.
        """
        asked = {
            "silence": self.silence,
            "scramble": () if self.scramble else None,
            "drop": None if self.drop is None else (self.drop,),
            "delay": None if self.delay is None else (self.delay,),
        }
        given = {name: values for name, values in asked.items() if values is not None}
        if len(given) > 1:
            raise UserError(f"one thing at a time can be done to messages, not --{' and --'.join(given)}")
        return "".join(" ".join((name, *map(str, values))) for name, values in given.items())


@dataclass(frozen=True)
class Page:
    """A page beside the training."""

    view: bool = False
    """Serve a page on which the policy plays while it learns, its curves beside (pip install 'gacrl[view]')."""
    view_host: str = HOST
    """The address that the page listens on. Any other than this one lets other machines in."""
    view_port: int = PORT
    """Its port; 0 takes any that is free."""


MESSAGES = Annotated[Messages, tyro.conf.arg(name="")]
ON_TASK = Annotated[Outside, tyro.conf.arg(name="")]


@dataclass(frozen=True)
class Settings(RunConfig):
    """Everything that determines a run; the task is named by --env."""

    task: Annotated[str, tyro.conf.Suppress] = tasks.DEFAULT

    @classmethod
    def of(cls, config: RunConfig) -> "Settings":
        """Return the same settings."""
        return cls(**{field.name: getattr(config, field.name) for field in fields(RunConfig)})

    def plain(self) -> RunConfig:
        """Return the same settings, as everyone else has them."""
        return RunConfig(**{field.name: getattr(self, field.name) for field in fields(RunConfig)})


@dataclass(frozen=True)
class Train:
    """Train, with a live progress line, and write a run folder.

    Settings come from the preset, then --config, then the flags below.

    examples:
      gacrl train                                     GACRL that solves the task
      gacrl train --preset paper --num-seeds 2        the paper's whole schedule, a seed on each core
      gacrl train --preset paper --episodes 100 --algorithm.learning-rate 1e-3 --out runs/quick
      gacrl train --config my.json --seed 7           `gacrl config` prints such a file
      gacrl train --env examples/own_task.py:Beacon --env.places 7    a task of your own
      gacrl train --env pettingzoo:mpe2.simple_spread_v3 --env.N 4    an environment of PettingZoo
      gacrl train --from runs/gacrl-1                 start with the policy of a run
      gacrl train --track tensorboard,trackio         pip install 'gacrl[track]'
      gacrl train --view                              watch it learn; pip install 'gacrl[view]'
    """

    settings: Annotated[Settings, tyro.conf.arg(name="")]
    outside: ON_TASK = Outside()
    begin_from: Annotated[str | None, tyro.conf.arg(name="from", metavar="RUN")] = None
    """Start with what a run has learned: a folder, FOLDER@k or FOLDER@best, or pretrained:NAME."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A JSON file of settings, all or some."""
    env_steps: int | None = None
    """Environment steps of each seed (short for --training.env-steps)."""
    episodes: int | None = None
    """The same, counted in episodes."""
    out: Path | None = None
    """The run folder; none: the next free one under runs/. One that exists is never overwritten."""
    track: Annotated[str, tyro.conf.arg(metavar="NAMES")] = ""
    """Also write every evaluation elsewhere: csv, tensorboard, trackio, wandb, or several with commas."""
    page: Annotated[Page, tyro.conf.arg(name="")] = Page()
    cluster: Annotated[Cluster, tyro.conf.arg(name="")] = Cluster()
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Resume:
    """Go on exactly where a run stopped: it ends with the same bits as one that never did.

    examples:
      gacrl resume runs/paper-1
      gacrl resume runs/paper-1 --extend 37500        500 more episodes of 75 steps
      gacrl resume runs/paper-1 --diagnose            which update it was that diverged
    """

    run: tyro.conf.Positional[Path]
    """A run folder."""
    extend: int | None = None
    """Environment steps to train past the planned end."""
    diagnose: bool = False
    """Write nothing, but play on from the newest checkpoint, and print the first update that is not finite."""
    outside: ON_TASK = Outside()
    track: Annotated[str, tyro.conf.arg(metavar="NAMES")] = ""
    """Also write every evaluation elsewhere: csv, tensorboard, trackio, wandb, or several with commas."""
    page: Annotated[Page, tyro.conf.arg(name="")] = Page()
    cluster: Annotated[Cluster, tyro.conf.arg(name="")] = Cluster()
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Evaluate:
    """Measure a policy on fixed episodes: greedy and sampled, beside policies that learn nothing.

    RUN may be one of these: random, noop (which does nothing), or a scripted policy of the task. Spread has oracle,
    which sees everything, and local, which sees what is near and assigns nothing. A score_ in the JSON is 0 for random
    and 1 for the first scripted policy of the task.

    Flags --env.X change the task's settings; --X is short for them where no other flag has that name.

    examples:
      gacrl evaluate runs/paper-1
      gacrl evaluate runs/paper-1 --horizon 25 --backend mpe2
      gacrl evaluate oracle --num-agents 10 --arena-scale 1.83 --horizon 75
      gacrl evaluate runs/gacrl-1 --silence 0 2       what are the messages of these two agents worth?
      gacrl evaluate RUN --utter --backend mpe2       its symbols as MPE2's utterances (docs/guides/talking.md)
    """

    run: tyro.conf.Positional[str]
    """A run folder; FOLDER@k for its k-th seed, from 0; FOLDER@best for its best policy; or a policy by name."""
    episodes: int = 320
    """Episodes to play."""
    horizon: int | None = None
    """Steps of an episode (short for --env.max-cycles); none: as many as in training, or the task's own."""
    backend: Literal["jax", "mpe2"] = "jax"
    """Our environment, or the real MPE2."""
    num_agents: int | None = None
    """Play with another number of agents (short for --env.num-agents)."""
    messages: MESSAGES = Messages()
    utter: bool = False
    """Send the symbols as the task's own utterance actions, which are heard a step later."""
    outside: ON_TASK = Outside()
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Render:
    """Draw episodes as an animated GIF or MP4, or as a strip of moments (PNG): the task, who hears whom, what is said.

    MP4 needs ffmpeg. Flags --env.X change the task's settings, as in `gacrl evaluate`.

    examples:
      gacrl render runs/paper-1 --out paper.gif
      gacrl render runs/paper-1 --out paper.mp4
      gacrl render oracle --out oracle.gif --episodes 2
      gacrl render runs/gacrl-1 --silence --out silent.gif
      gacrl render pretrained:gacrl-reference --beside --episodes 2 --out both.png
    """

    run: tyro.conf.Positional[str]
    """A run folder, FOLDER@k, FOLDER@best, or a policy by name, as in `gacrl evaluate`."""
    out: Path = field(default=Path("episodes.gif"))
    """The file to write, .gif, .mp4 or .png; one that exists is not overwritten without --overwrite."""
    episodes: int = 4
    """Episodes to show."""
    horizon: int | None = None
    """Steps of an episode (short for --env.max-cycles); none: as many as in training, or the task's own."""
    num_agents: int | None = None
    """Play with another number of agents (short for --env.num-agents)."""
    messages: MESSAGES = Messages()
    outside: ON_TASK = Outside()
    sampled: bool = False
    """Explore as in training, instead of playing greedily."""
    beside: bool = False
    """Show the run as it is, and beside it the same starts with --silence, --scramble, --drop or --delay; without any
    of these, silenced."""
    size: int = 480
    """Width and height of a picture in pixels."""
    overwrite: bool = False
    """Replace a file that exists."""


@dataclass(frozen=True)
class Export:
    """Take a run elsewhere: its weights, its policy as a program, a page to play with, or its numbers.

    A policy is one seed's: the first, or FOLDER@k's. Flags --env.X change the task's settings, as in `gacrl evaluate`:
    programs are made for one number of agents. docs/guides/export.md says what is in the files.

    examples:
      gacrl export runs/gacrl-1 --out policy.safetensors
      gacrl export runs/gacrl-1@best --format npz --out policy.npz
      gacrl export pretrained:gacrl --out policy.onnx    pip install 'gacrl[onnx]'
      gacrl export pretrained:gacrl-teams --num-agents 10 --out policy.stablehlo
      gacrl export pretrained:gacrl-reference --out reference.html
      gacrl export runs/gacrl-1 --out metrics.csv
    """

    run: tyro.conf.Positional[str]
    """A run folder; FOLDER@k for its k-th seed, from 0; FOLDER@best for its best policy; or pretrained:NAME."""
    out: Path | None = None
    """The file to write; one that exists is not overwritten without --overwrite."""
    format: str | None = None
    """safetensors, npz, stablehlo, onnx, html or csv; none: what the name of the file says."""
    outside: ON_TASK = Outside()
    overwrite: bool = False
    """Replace a file that exists."""
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class View:
    """Show a policy live, on a page in the browser: silence it, speak in its place, drag, add agents, scrub and rewind.

    RUN is a run folder, FOLDER@k, FOLDER@best, pretrained:NAME, or a scripted policy of the task. Two of them play the
    same starts side by side. A run that is being trained plays with its newest parameters, its curves beside it. Flags
    --env.X change the task's settings, as in `gacrl evaluate`.

    examples:
      gacrl view pretrained:gacrl-reference           pip install 'gacrl[view]'
      gacrl view runs/gacrl-1 oracle
      gacrl view runs/mine-1 --env FILE.py:NAME
      gacrl view told --env reference --port 0
    """

    run: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN [OTHER]")]
    """One policy, or two."""
    sampled: bool = False
    """Explore as in training, instead of playing greedily."""
    num_agents: int | None = None
    """Begin with another number of agents (short for --env.num-agents)."""
    host: str = HOST
    """The address to listen on. Any other than this one lets other machines in, if they have the page's address."""
    port: int = PORT
    """The port to listen on; 0 takes any that is free."""
    open: bool = False
    """Open the page in a browser."""
    outside: ON_TASK = Outside()
    json: bool = False
    """Also print the page's address as a JSON object."""


@dataclass(frozen=True)
class Compare:
    """Compare finished runs: interquartile means over seeds with 95 % intervals, differences, chances to be better.

    Runs that differ in the seed alone are one group, named by their folders. Settings that make a comparison unequal
    are named; runs of other tasks, horizons or versions of the environment are refused.

    examples:
      gacrl compare runs/mappo-1 runs/qmix-1
      gacrl compare runs/mappo-1 runs/paper-1 --horizon 25 --label MAPPO "the paper's"
      gacrl compare runs/gacrl-1 runs/gacrl-2 runs/vdn-1 --metric coverage_final_0.1 --out runs/comparison
      gacrl compare runs/gacrl-1 runs/vdn-1 --metric coverage_final_0.1 --margin 0.02
      gacrl compare runs/gacrl-1 --out report.html      everything about one run, on a page with its episodes
    """

    run: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN …")]
    """Run folders."""
    metric: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A metric of the closing evaluation; may be given several times. None: the first two of the task's tables."""
    outside: ON_TASK = Outside()
    margin: float | None = None
    """Also test whether groups differ by less than this, in the units of the one metric (two one-sided tests)."""
    label: tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]] = ()
    """What to call the runs, or the groups, in their order; none: the names of their folders."""
    horizon: int | None = None
    """Play runs that were evaluated over other horizons again, over this many steps."""
    sampled: bool = False
    """Compare the policies as they explore, instead of greedily."""
    out: Path | None = None
    """Where to write the report: one HTML file where it ends in .html, else a folder for it, Markdown and figures."""
    replays: bool = True
    """Play the closing evaluation again, so that the report shows the best, the median and the 20 worst episodes."""
    csv: Path | None = None
    """A file for every seed's value of every metric, a row each."""
    marl_eval: Path | None = None
    """A file to write the runs into as marl-eval's raw data."""
    overwrite: bool = False
    """Replace a page or file that exists."""
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Presets:
    """List what can be trained by name.

    examples:
      gacrl presets
    """

    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Tasks:
    """List what can be trained on, with the scores of policies that learn nothing, and of silent and of told ones.

    examples:
      gacrl tasks
      gacrl tasks --env examples/own_task.py:Beacon    one of your own beside them
    """

    outside: ON_TASK = Outside()
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Config:
    """Print a preset's settings, complete, as a file that `gacrl train --config FILE` loads.

    examples:
      gacrl config --preset paper > my.json
    """

    preset: str = presets.DEFAULT_PRESET
    """Which preset."""
    outside: ON_TASK = Outside()


@dataclass(frozen=True)
class Reproduce:
    """Make the paper's whole experiment, and a report of every table, figure and claim, theirs beside ours.

    GACRL, QMIX, MAPPO and IPPO train on the paper's reward and on MPE2's own; random, noop and oracle play the
    same task. Stopped or killed, the same command goes on with what is missing.

    examples:
      gacrl reproduce                                 5 seeds
      gacrl reproduce --seeds 2 --episodes 200 --out runs/look
    """

    seeds: int = 5
    """Seeds of each algorithm."""
    episodes: int = 1500
    """Episodes of each seed; fewer stop the paper's schedule early."""
    out: Path = Path("runs/reproduce")
    """The folder of the runs and the report."""
    extended: bool = False
    """Also train them, and VDN, in earnest: MPE2's 25 steps, equal torso, symmetry, reward and number of steps."""
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Ablate:
    """Train GACRL with every part off in turn, and say what each part is worth, with intervals over seeds.

    What a part's parameters were goes to the rest of the network, so that all have as many. Stopped or killed, the same
    command goes on with what is missing.

    examples:
      gacrl ablate                                    every part, 5 seeds, 112,500 steps each
      gacrl ablate --env reference --seeds 3 --env-steps 40000 --out runs/ablation-reference
      gacrl ablate --part no-messages --part no-graph --seeds 2 --env-steps 30000 --out runs/look
    """

    preset: str | None = None
    """The preset that is taken apart, a GACRL one; none: gacrl-112k, and gacrl on tasks that need talk."""
    part: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """What is taken away; may be given several times. None: everything."""
    seeds: int = 5
    """Seeds of each."""
    seed: int = 0
    """The first of them."""
    env_steps: int | None = None
    """Environment steps of each seed; none: the preset's."""
    updates: int | None = None
    """Gradient steps after each rollout; none: half of the preset's, and all on tasks that need talk. All of it takes
    about an hour on two cores."""
    outside: ON_TASK = Outside()
    out: Path = Path("runs/ablation")
    """The folder of the runs and the report."""
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Talk:
    """Train silent, talking and told agents on a task, and say whether it needs talk and whether the agents use it.

    The three are about as large and train for as many steps; told agents hear all that their neighbours see. Then
    the talking ones play with their messages silenced, scrambled and delayed. Stopped or killed, the same command
    resumes with what is missing.

    Without --env: the study of all our tasks that need talk, each with every kind of communication and other learners,
    in runs/talk. Cells that are done are not run again, and the report shows all that are there.

    examples:
      gacrl talk --env reference
      gacrl talk --env examples/own_task.py:Beacon --env-steps 10000
      gacrl talk --env colours --env.graph full --env-steps 120000 --out runs/full
      gacrl talk --env colours --preset ippo --env-steps 1e6 --seeds 5 --out runs/colours
      gacrl talk --env reference --known docs/data/talk-reference-study.json
      gacrl talk --tasks speaker_listener reference colours
      gacrl talk --tasks reference --kinds discrete tarmac --scale 0.1 --out runs/look
    """

    preset: str = "gacrl"
    """The preset that trains all of them."""
    seeds: int = 3
    """Seeds of each."""
    seed: int = 0
    """The first of them."""
    env_steps: int | None = None
    """Environment steps of each seed, with --env; none: 40,000."""
    known: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """With --env: take the silent and the told learner from here, a summary.json of `gacrl talk` with as many steps
    and the same settings of the task, and train the talking one alone."""
    tasks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TASK …")] = ()
    """Tasks of the study: speaker_listener, reference, colours, colours-full, colours-unnamed, scouts,
    traffic_junction; none: all."""
    kinds: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KIND …")] = ()
    """Its learners: none, none-recurrent, told, discrete, soft, dial, commnet, tarmac, ic3net, actions (words among the
    actions), mappo, mappo-10x, qmix, or messages of your own (--use); none: all. Silent and told ones are always
    trained: scores run from the ones to the others."""
    scale: float = 1.0
    """Factor of its environment steps: those of the tasks are 30,000 to 800,000."""
    trials: int = 1
    """Learning rates that each of its learners may try, 1 to 5, on two seeds of their own for as many steps."""
    outside: ON_TASK = Outside()
    out: Path | None = None
    """The folder of the runs and the report; by default runs/talk-TASK, or runs/talk for the study."""
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Sweep:
    """Search settings: a file of ranges, or the paper's grid. Stopped or killed, the same command goes on.

    FILE.toml says what is searched and by which metric (docs/guides/cluster.md); every trial is a run folder. Trials
    are trained here, one after the other, or on a Ray cluster, where Optuna proposes them and poor ones are given up.

    paper-grid is the paper's: 27 settings of learning rate, ε and τ at the start (random actions, temperature of
    messages), by shaped reward over the first 500 episodes. The winner is trained again on fresh seeds beside the
    paper's choice, and the report says how much of the differences chance alone makes.

    examples:
      gacrl sweep search.toml
      gacrl sweep search.toml --ray 10.0.0.1:6379     pip install 'gacrl[ray]'
      gacrl sweep paper-grid --out runs/grid
    """

    spec: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SPEC")]
    """A TOML file, or paper-grid."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="HOST:PORT")] = None
    """The head of a Ray cluster, or auto."""
    trial_cpus: float = 1.0
    """CPU cores that a trial takes, with --ray."""
    trial_gpus: float = 0.0
    """And GPUs."""
    seeds: int | None = None
    """Seeds of each point of paper-grid; none: 2."""
    episodes: int | None = None
    """Episodes of each seed of paper-grid; none: 500."""
    outside: ON_TASK = Outside()
    out: Path | None = None
    """The folder of the results and the report; none: runs/ and the name of the file or grid."""
    json: bool = False
    """Make the last line of the output one JSON object."""


@dataclass(frozen=True)
class Doctor:
    """Check this machine: devices, parity with the installed MPE2, and that algorithms learn the probes.

    examples:
      gacrl doctor
    """

    json: bool = False
    """Make the last line of the output one JSON object."""
