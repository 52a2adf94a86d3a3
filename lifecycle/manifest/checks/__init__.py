"""Static checks of a manifest, one module each; registry.py lists them."""
