"""Goals of actions, and the handlers at work on them."""
