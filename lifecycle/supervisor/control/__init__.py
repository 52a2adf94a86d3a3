"""The control socket: status and orders from outside, and asking for them."""
