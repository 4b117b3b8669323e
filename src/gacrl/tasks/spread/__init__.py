"""MPE2's simple_spread_v3: agents that must cover landmarks together."""
