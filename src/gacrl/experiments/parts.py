"""The parts of GACRL that an ablation takes away, by name: what is left, and the settings that change."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from gacrl import tasks
from gacrl.config import files as configuration
from gacrl.config.run import RunConfig
from gacrl.tasks.task import Part

NO_MESSAGES, YOKED = "no-messages", "yoked-exploration"
PRESET, TALKING_PRESET = "gacrl-112k", "gacrl"
"""What is taken apart where nobody says: on most tasks, and on those that need talk."""


def _network(**changes: Any) -> Mapping[str, Any]:
    return {"algorithm": {"network": changes}}


def _algorithm(**changes: Any) -> Mapping[str, Any]:
    return {"algorithm": changes}


PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "no-graph": Part(
            "layers over the observation vector in place of the entity graph",
            _network(torso="mlp", second_look=False),
        ),
        NO_MESSAGES: Part(
            "zero rounds of messages; a critic that is told is central",
            _network(communication="none", gate=False, word_price=0.0),
        ),
        "soft-messages": Part("symbols soft in play too, a continuous message", _network(communication="soft")),
        "straight-through": Part(
            "one-hot symbols with noise while learning", _network(symbols="straight_through", symbol_noise=1.0)
        ),
        "no-second-look": Part("nothing is looked at after the messages", _network(second_look=False)),
        "blunt-look": Part("the second look's attention as wide as usual", _network(look_sharpness=1.0)),
        "no-seen-slope": Part("ReLUs over landmarks, which can lose sight of some", _network(seen_slope=0.0)),
        "no-heard-slope": Part("ReLUs that hear, which can fall silent", _network(heard_slope=0.0)),
        "no-logit-price": Part("large logits of symbols cost nothing", _network(logit_price=0.0)),
        "warm-symbols": Part("τ stays at 1", _algorithm(temperature=1.0, temperature_end=1.0)),
        "no-latent": Part("symbols made of the agent's vector, without a code", _network(latent="none")),
        "plain-code": Part("a deterministic code", _network(latent="deterministic")),
        "untold-critic": Part("a central critic that nobody tells anything", _algorithm(critic="central")),
        "no-central-critic": Part("values summed, as VDN does", _algorithm(critic="sum")),
        "linear-exploration": Part("ε and τ fall with time alone", _algorithm(exploration="linear")),
        "fixed-exploration": Part("ε and τ stay at their end", _algorithm(exploration="fixed")),
        YOKED: Part(
            "explores as much as 'all parts' did at that time (mean over its seeds), whatever its own progress is",
            _algorithm(exploration="yoked"),
        ),
        "no-symmetry": Part("what is replayed is not turned", _algorithm(augment=False)),
        "one-step": Part("targets of one reward", _algorithm(n_step=1)),
        "no-average": Part("played with the parameters that learn", _algorithm(averaged=False)),
    }
)
"""By what is left, as `gacrl ablate --part` names it; a task may have further ones (`Task.parts`)."""


def parts_of(config: RunConfig) -> dict[str, Part]:
    """All that these settings have and that can be taken away on this task."""
    known = {**PARTS, **tasks.find(config.task).parts}
    return {name: part for name, part in known.items() if configuration.from_dict(part.changes, config) != config}


def usual_preset(task: str | None) -> str:
    """Return the preset that is taken apart on a task where nobody says which; None: no task is named."""
    return TALKING_PRESET if task is not None and tasks.find(task).needs_talk else PRESET
