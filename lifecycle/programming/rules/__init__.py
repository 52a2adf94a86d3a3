"""Verified flows as rules, settings and request bodies of other systems, and as tables. Pure."""
