"""Plans and what runs as files: pictures, captured manifests, SROS2 documents. Pure."""

from lifecycle.doors import open_door

__getattr__, __dir__, __all__ = open_door(__name__, __file__)
