"""The nodes of a system: how far each has come, how it is driven there, and who sees it."""
