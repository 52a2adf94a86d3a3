"""The loop that owns a run's state, and the ports that carry out what the core wants done."""
