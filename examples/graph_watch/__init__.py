"""Programs that follow a graph: one reacts to a new publisher, one asks whether a system runs."""
