"""Networks that can be programmed, one module each; registry.py lists them."""
