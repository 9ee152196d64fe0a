"""One TOML a task: topics, clocks, rates, image geometry, presets. `--task NAME` finds NAME.toml here."""
