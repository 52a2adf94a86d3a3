"""Delay, rate, loss and silence of data, from what a subscription counts. Pure."""
