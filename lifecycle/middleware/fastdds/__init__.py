"""Fast DDS participants with settings of their own: profiles, URLs, flows."""
