"""The process that hosts nodes: under a supervisor by a socket, or alone in a terminal."""
