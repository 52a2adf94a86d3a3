"""Fast DDS participants with their own settings: XML profiles, connection URLs, network flows."""
