"""The process itself: timers, threads, shared memory, and the way out of DDS."""
