"""Pictures of a plan, and of what runs beside it: text, Mermaid, SVG, HTML. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from lifecycle.export.picture.drawing import picture_to_svg
from lifecycle.export.picture.model import Picture
from lifecycle.export.picture.page import picture_to_html
from lifecycle.export.picture.text import picture_to_mermaid, picture_to_text

WRITERS: Mapping[str, Callable[[Picture], str]] = {
    "text": picture_to_text,
    "mermaid": picture_to_mermaid,
    "svg": picture_to_svg,
    "html": picture_to_html,
}
"""What writes a picture, by the value of `--format`."""
