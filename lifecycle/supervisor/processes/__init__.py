"""The processes of a system: fork server, control channel, logs, run directory, orphans."""
