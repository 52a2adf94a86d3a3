"""Looks at the running system, and judges what is there by the manifest."""
