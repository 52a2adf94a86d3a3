"""One file per verb: `lifecycle NAME` is the click command named `command` in NAME.py."""
