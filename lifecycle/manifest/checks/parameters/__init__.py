"""Checks of parameters and parameter files."""
