"""Checks of network flows."""
