"""The processes of a system: fork server, control channel, logs, what they leave behind."""
