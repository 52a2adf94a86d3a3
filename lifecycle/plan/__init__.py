"""Manifest → Plan: the computational and the data layer graph of a system, ready to run. Pure."""
