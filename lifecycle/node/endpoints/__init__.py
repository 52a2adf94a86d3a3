"""Declared endpoints: the entities that stand for them, and where these are."""
