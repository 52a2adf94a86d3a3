"""The gate: verdicts of the running system, permits, the sequence that opens it, and the hold."""
