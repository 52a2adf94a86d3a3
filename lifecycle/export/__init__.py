"""Plans and what runs as files: pictures, captured manifests, SROS2 documents. Pure."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
