"""Checks of connections and discovery."""
