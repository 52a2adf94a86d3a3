"""How endpoints are called in requests and messages: `video`, or `publishers/video`.

Owns: what a spelling means, and what is said when a spelling names nothing or too much. Pure.
"""

from __future__ import annotations

from collections.abc import Iterable

from lifecycle.errors import LifecycleError
from lifecycle.manifest.model import EndpointKind
from lifecycle.node.author.handlers import nearest

Key = tuple[EndpointKind, str]
"""Kind and declared name: what identifies an endpoint within its node."""


class UnknownEndpointError(LifecycleError, KeyError):
    """Code asked for an endpoint by a name that no interface declares."""


def find(spelling: str, declared: Iterable[Key], *, node: str) -> Key:
    """Return the endpoint that a spelling means.

    Args:
        spelling: `publishers/video`, or the declared name alone where no other kind has it.
        declared: every declared endpoint.
        node: fully qualified node name, for messages.

    Raises:
        UnknownEndpointError: it means none, or more than one.
    """
    keys = list(declared)
    by_spelling = {kind.spell(name): (kind, name) for kind, name in keys}
    if spelling in by_spelling:
        return by_spelling[spelling]
    named = [key for key in keys if key[1] == spelling]
    if len(named) == 1:
        return named[0]
    if named:
        choices = " or ".join(repr(kind.spell(name)) for kind, name in named)
        raise UnknownEndpointError(
            f"cannot tell which {spelling!r} of {node} is meant", hint=f"write {choices}"
        )
    if not keys:
        raise UnknownEndpointError(
            f"cannot find endpoint {spelling!r} of {node}",
            hint="endpoints are declared at configure; ask from on_configure on",
        )
    near = nearest(spelling, by_spelling)
    if not near:
        kind, _, name = spelling.partition("/")
        is_kind = kind in {each.value for each in EndpointKind}
        near_name = nearest(name if is_kind else spelling, [name for _, name in keys])
        near = next((each for each, key in by_spelling.items() if key[1] == near_name), "")
    listed = ", ".join(repr(each) for each in by_spelling)
    raise UnknownEndpointError(
        f"cannot find endpoint {spelling!r} of {node}",
        hint=(f"did you mean {near!r}? " if near else "") + f"declared: {listed}",
    )
