"""What can be chosen by name: kinds of messages and rules of exploration, and where each of them is.

An entry is the thing itself, or `module:attribute`, which is imported when it is chosen. One line adds another:
`COMMUNICATION["shout"] = Shout` (examples/own_messages.py).
"""

from importlib import import_module
from typing import Any

COMMUNICATION: dict[str, Any] = {
    "none": "gacrl.networks.communication.none:Silence",
    "commnet": "gacrl.networks.communication.commnet:CommNet",
    "dial": "gacrl.networks.communication.dial:Dial",
    "told": "gacrl.networks.communication.told:Told",
    "tarmac": "gacrl.networks.communication.tarmac:Tarmac",
    "ic3net": "gacrl.networks.communication.ic3net:Ic3net",
    "discrete": "gacrl.networks.communication.symbols:DiscreteSymbols",
    "soft": "gacrl.networks.communication.symbols:SoftSymbols",
}
"""Classes of `gacrl.networks.communication.base.Communication`."""

EXPLORATION: dict[str, Any] = {
    "none": "gacrl.algorithms.exploration:none",
    "linear": "gacrl.algorithms.exploration:linear",
    "fixed": "gacrl.algorithms.exploration:fixed",
    "adaptive": "gacrl.algorithms.exploration:adaptive",
    "yoked": "gacrl.algorithms.exploration:yoked",
}
"""Functions (settings of the learner, planned environment steps, the task's measure of progress) -> Exploration."""


def resolve(entry: Any) -> Any:
    """Return what an entry stands for."""
    if not isinstance(entry, str):
        return entry
    module, _, name = entry.partition(":")
    return getattr(import_module(module), name)
