"""A document against its JSON Schema, in messages that people can act on."""
