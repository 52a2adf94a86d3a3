"""The managed node: state machine, transitions, callbacks, and what works only while active."""
