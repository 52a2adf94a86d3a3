"""The process itself: timers, threads, shared memory, and leaving DDS at exit."""
