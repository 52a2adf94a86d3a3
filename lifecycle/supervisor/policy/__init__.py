"""What the manifest wants done about what goes wrong: it decides, others notice and carry out."""
