"""What the agents of a navigation task say for each goal that they know, at the first step of many episodes.

    python benchmarks/meanings.py pretrained:gacrl-reference --episodes 300

Prints, for each agent and round, how often each symbol stands for each goal, and the bits that it tells of it.
"""

import argparse
from collections import Counter

import jax
import numpy as np

import gacrl

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def told_bits(pairs: Counter[tuple[int, str]]) -> float:
    """Return the mutual information of goal and symbol, in bits."""
    total = sum(pairs.values())
    goals, symbols = Counter[int](), Counter[str]()
    for (goal, symbol), count in pairs.items():
        goals[goal] += count
        symbols[symbol] += count
    shares = ((count / total, goals[g] * symbols[s] / total**2) for (g, s), count in pairs.items())
    return float(sum(share * np.log2(share / apart) for share, apart in shares))


def main() -> None:
    """Play the first step of each episode and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run")
    parser.add_argument("--episodes", type=int, default=300)
    asked = parser.parse_args()
    policy = gacrl.load_policy(asked.run)
    env, knows = policy.env, policy.env.rules.knows
    reset = jax.jit(lambda key: env.reset(key))
    counts: dict[tuple[int, int], Counter[tuple[int, str]]] = {}
    for number in range(asked.episodes):
        policy.reset()
        state, seen = reset(jax.random.key(number))
        policy(np.asarray(seen.features), greedy=True)
        said = np.asarray(policy.messages).argmax(-1)
        for place, symbols in enumerate(said):
            for agent, symbol in enumerate(symbols):
                if knows[agent] >= 0:
                    pair = (int(state.goals[knows[agent]]), LETTERS[symbol])
                    counts.setdefault((agent, place), Counter())[pair] += 1
    for (agent, place), pairs in sorted(counts.items()):
        print(f"agent {agent}, round {place + 1}: {told_bits(pairs):.2f} bits of the goal")
        for goal in sorted({goal for goal, _ in pairs}):
            of_goal = Counter({symbol: count for (g, symbol), count in pairs.items() if g == goal})
            total = sum(of_goal.values())
            print(
                f"  goal {goal}: " + ", ".join(f"{s} {100 * c / total:.0f} %" for s, c in of_goal.most_common(4))
            )


if __name__ == "__main__":
    main()
