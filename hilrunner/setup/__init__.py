"""Everything before tick 0; may raise: profile, signals, model, bus, host, arm."""
