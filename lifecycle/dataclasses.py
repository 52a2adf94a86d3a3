"""The standard library's dataclasses, whose methods are made when they are first looked up.

Owns: `dataclass`, the decorator of this package's types; all else is the standard library's. Its
own takes 0.4 ms a class to write and compile six methods, and several hundred classes are imported
by a process that calls few of them; and as long as all else to see which annotations are fields,
which here all are that say nothing special. Imports nothing of the package.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import sys
import threading
import types
from collections.abc import Callable, Iterator
from dataclasses import FrozenInstanceError, field, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

__all__ = [
    "FrozenInstanceError",
    "dataclass",
    "field",
    "fields",
    "is_dataclass",
    "make_constructors",
    "replace",
]

_ABSENT = dataclasses.MISSING
_lock = threading.Lock()
_classes: list[type] = []
"""All whose methods are made so."""


class _Method:
    """A method of one class that is made when it is looked up, and then takes this one's place."""

    __slots__ = ("_cls", "_frozen", "_name")

    def __init__(self, name: str, *, frozen: bool) -> None:
        self._name = name
        self._frozen = frozen

    def __set_name__(self, owner: type, name: str) -> None:
        self._cls = owner

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        is_init = self._name == "__init__"
        method = _init(self._cls, frozen=self._frozen) if is_init else _made(self._cls, self._name)
        method.__qualname__ = f"{self._cls.__qualname__}.{self._name}"
        method.__module__ = self._cls.__module__
        setattr(self._cls, self._name, method)
        return method if instance is None else method.__get__(instance, owner)


def make_constructors(*prefixes: str) -> None:
    """Make `__init__` of the types of some modules, for a process that forks those who call it.

    Args:
        prefixes: what the modules' names begin with.
    """
    for each in _classes:
        if each.__module__.startswith(prefixes):
            getattr(each, "__init__")  # noqa: B009 - looking it up is the point


def _init(cls: Any, *, frozen: bool) -> Any:
    """Return `__init__` as the standard library has it."""
    taken: dict[bool, list[str]] = {False: [], True: []}
    body: list[str] = []
    known: dict[str, Any] = {"_absent": _ABSENT, "_set": object.__setattr__}
    for each in fields(cls):
        name, value = each.name, each.name
        if each.default_factory is not _ABSENT:
            known[f"_make_{name}"] = each.default_factory
            value = f"_make_{name}()" + f" if {name} is _absent else {name}" * each.init
        if each.default is not _ABSENT:
            known[f"_default_{name}"] = each.default
            value = name if each.init else f"_default_{name}"
        if each.init:
            default = f"=_default_{name}" * (each.default is not _ABSENT)
            default += "=_absent" * (each.default_factory is not _ABSENT)
            taken[bool(each.kw_only)].append(f"{name}{default}")
        elif value == name:
            continue
        body.append(f" _set(self, {name!r}, {value})" if frozen else f" self.{name} = {value}")
    if hasattr(cls, "__post_init__"):
        body.append(" self.__post_init__()")
    names = ", ".join(["self", *taken[False], *["*"][: len(taken[True])], *taken[True]])
    exec("\n".join([f"def __init__({names}):", *body, " return"]), known)  # noqa: S102
    made = known["__init__"]
    made.__annotations__ = {each.name: each.type for each in fields(cls) if each.init}
    made.__annotations__["return"] = None
    return made


def _made(cls: Any, name: str) -> Any:
    """Have the standard library make another method, of a class with the same fields."""
    namespace: dict[str, Any] = {each.name: each for each in fields(cls)}
    namespace["__annotations__"] = {each.name: each.type for each in fields(cls)}
    namespace["__module__"] = cls.__module__
    namespace["__doc__"] = cls.__name__
    twin: Any = dataclasses.dataclass(
        init=False,
        repr=name == "__repr__",
        eq=name in {"__eq__", "__hash__"},
        unsafe_hash=name == "__hash__",
        match_args=False,
    )(type(cls.__name__, (), namespace))
    return vars(twin)[name]


def _refuse_set(self: object, name: str, value: object) -> NoReturn:  # noqa: ARG001
    raise FrozenInstanceError(f"cannot assign to field {name!r}")


def _refuse_delete(self: object, name: str) -> NoReturn:  # noqa: ARG001
    raise FrozenInstanceError(f"cannot delete field {name!r}")


def _get_state(self: Any) -> list[Any]:
    return [getattr(self, each.name) for each in fields(self)]


def _set_state(self: Any, state: list[Any]) -> None:
    for each, value in zip(fields(self), state, strict=True):
        object.__setattr__(self, each.name, value)


_FROZEN = {
    "__setattr__": _refuse_set,
    "__delattr__": _refuse_delete,
    "__getstate__": _get_state,
    "__setstate__": _set_state,
}


@contextlib.contextmanager
def _as_if_not_frozen(bases: tuple[type, ...]) -> Iterator[None]:
    """Let the standard library derive a class from frozen ones that it is not told is frozen."""
    with _lock:
        parameters = [
            vars(each)["__dataclass_params__"]
            for base in bases
            for each in base.__mro__
            if "__dataclass_params__" in vars(each)
        ]
        frozen = [each for each in parameters if each.frozen]
        for each in frozen:
            each.frozen = False
        try:
            yield
        finally:
            for each in frozen:
                each.frozen = True


@dataclasses.dataclass(init=False, repr=False, eq=False, slots=True)
class _Plain:
    """What the standard library makes of a class with one field, before it makes methods."""

    of: int
    shared: ClassVar[int] = 0


_OWN = {
    name: vars(_Plain)[name]
    for name in ("__replace__",)  # Python 3.13
    if name in vars(_Plain)
}
_PARAMETERS = _Plain.__dataclass_params__  # type: ignore[attr-defined]
_PARAMETERS.init = _PARAMETERS.repr = True
_FIELD_TYPE = fields(_Plain)[0]._field_type  # type: ignore[attr-defined]  # noqa: SLF001
_SHARED_TYPE = _Plain.__dataclass_fields__["shared"]._field_type  # type: ignore[attr-defined]  # noqa: SLF001
_SPECIAL = ("ClassVar", "InitVar", "KW_ONLY")


def _are_class_variables(cls: Any, names: set[str]) -> bool:
    """Return whether names that are annotated so are nothing but that, where there are any."""
    module = sys.modules.get(cls.__module__)
    imported = not names or getattr(module, "ClassVar", None) is ClassVar
    return imported and not any(isinstance(vars(cls).get(n), dataclasses.Field) for n in names)


def _fields_of(cls: Any, *, kw_only: bool) -> dict[str, Any] | None:
    """Return the fields of a class as the standard library has them, with those of its bases.

    It looks up what each annotation may mean, and those of ours mean a field, or begin with
    ClassVar; None where that is not so, or something is wrong that it has a message for.
    """
    own = vars(cls).get("__annotations__", {} if sys.version_info < (3, 14) else None)
    if own is None or not all(type(each) is str for each in own.values()):
        return None
    shared = {name for name, each in own.items() if each.startswith("ClassVar[")}
    text = " ".join(each for name, each in own.items() if name not in shared)
    if any(each in text for each in _SPECIAL) or not _are_class_variables(cls, shared):
        return None
    every: dict[str, Any] = {}
    for base in cls.__mro__[-2:0:-1]:
        every.update(getattr(base, "__dataclass_fields__", ()))
    for name, annotation in own.items():
        found = vars(cls).get(name, _ABSENT)
        if name in shared:
            found = every[name] = field(default=found)
            found.name, found.type, found._field_type = name, annotation, _SHARED_TYPE  # noqa: SLF001
            continue
        if not isinstance(found, dataclasses.Field):
            if found is _ABSENT and name in every:
                found = getattr(cls, name, _ABSENT)  # a base's default, unless it is its slot
                found = _ABSENT if isinstance(found, types.MemberDescriptorType) else found
            found = field(default=found, kw_only=kw_only)
        elif found.kw_only is _ABSENT:
            found.kw_only = kw_only
        if found.default.__class__.__hash__ is None:
            return None
        found.name, found.type, found._field_type = name, annotation, _FIELD_TYPE  # noqa: SLF001
        every[name] = found
    if any(isinstance(each, dataclasses.Field) and n not in own for n, each in vars(cls).items()):
        return None
    return every


def _decorate(cls: Any, *, frozen: bool, kw_only: bool, eq: bool) -> type:
    own = dict(vars(cls))
    if "__slots__" in own:
        raise TypeError(f"{cls.__name__} already specifies __slots__")
    if own["__doc__"] is None:
        cls.__doc__ = own["__doc__"] = cls.__name__  # else it is made of the signature
    if "__eq__" in own and own["__hash__"] is None:
        del own["__hash__"]  # which Python has set, not its author
    every = _fields_of(cls, kw_only=kw_only)
    if every is None:
        with _as_if_not_frozen(cls.__bases__):
            plain: Any = dataclasses.dataclass(init=False, repr=False, eq=False, kw_only=kw_only)
            every = plain(cls).__dataclass_fields__
    taken: set[str] = set()
    for base in cls.__mro__[1:-1]:
        slots = vars(base).get("__slots__", ())
        taken.update((slots,) if isinstance(slots, str) else slots)
    parameters: Any = copy.copy(_PARAMETERS)
    parameters.eq, parameters.frozen = eq, frozen
    known = {name: each for name, each in every.items() if each._field_type is _FIELD_TYPE}  # noqa: SLF001
    shown = [name for name, each in known.items() if each.init and not each.kw_only]
    names = ["__init__", "__repr__", *["__eq__"] * eq, *["__hash__"] * (eq and frozen)]
    namespace = {
        **_OWN,
        "__match_args__": tuple(shown),
        **{name: _Method(name, frozen=frozen) for name in names},
        **({"__hash__": None} if eq and not frozen else {}),
        **(_FROZEN if frozen else {}),
        **own,
        "__qualname__": cls.__qualname__,
        "__dataclass_fields__": every,
        "__dataclass_params__": parameters,
        "__slots__": tuple(name for name in known if name not in taken),
    }
    for name in (*known, "__dict__", "__weakref__"):
        namespace.pop(name, None)
    made = type(cls)(cls.__name__, cls.__bases__, namespace)
    _classes.append(made)
    return made  # type: ignore[no-any-return]


if TYPE_CHECKING:
    from dataclasses import dataclass
else:

    def dataclass(
        *, frozen: bool = False, slots: bool = False, kw_only: bool = False, eq: bool = True, **more
    ) -> Callable[[type], type]:
        """As the standard library's decorator."""
        if not slots or more:
            options = {"frozen": frozen, "slots": slots, "kw_only": kw_only, "eq": eq, **more}
            return dataclasses.dataclass(**options)
        return lambda cls: _decorate(cls, frozen=frozen, kw_only=kw_only, eq=eq)
