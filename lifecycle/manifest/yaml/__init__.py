"""YAML text to positioned values: parsing, limits, includes, arguments."""
