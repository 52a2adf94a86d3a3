"""What a supervisor decides: a state, `take(run, now_s, input)` and `advance(run)`; pure."""
