"""Validated documents to frozen types."""
