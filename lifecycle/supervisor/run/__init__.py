"""One run of one system: what must be there before it, its session, its events, and its end."""
