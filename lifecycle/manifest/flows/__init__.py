"""What flow needs come to: classes, marks."""
