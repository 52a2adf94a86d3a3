"""The verbs: `lifecycle NAME` is `command` in NAME.py, or what VERBS says."""
