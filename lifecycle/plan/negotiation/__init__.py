"""From parties, wishes and terms to the data layer graph."""
