"""Play a trained policy in the real MPE2, as any other program would: dictionaries in, dictionaries out."""

from mpe2 import simple_spread_v3

import gacrl

policy = gacrl.load_policy("pretrained:gacrl")
env, earned = simple_spread_v3.parallel_env(max_cycles=25), 0.0
observations, _ = env.reset(seed=0)
while env.agents:
    observations, rewards, *_ = env.step(policy(observations))
    earned += sum(rewards.values()) / len(rewards)
print(f"return {earned:.2f}")
