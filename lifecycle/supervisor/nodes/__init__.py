"""The nodes of a system: how far each is brought up, how it is driven there, and who sees it."""
