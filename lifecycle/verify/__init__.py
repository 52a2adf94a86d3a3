"""Verifies Plan × Observation → Verdict, and reports it. Pure: no ROS, no files, no clock."""
