"""A program that reacts to a new publisher of a topic, by the graph interface."""
