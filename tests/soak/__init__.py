"""`make soak`: seeded rounds of faults against supervision, judged from outside; see __main__.py."""
