"""NoDL v2 documents in place of an inline interface."""
