"""`make soak`: seeded rounds of faults against supervision, judged from outside."""
