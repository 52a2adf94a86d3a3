"""Our dataclasses do what the standard library's do, and make their methods when these are used."""

from __future__ import annotations

import copy
import dataclasses as standard
import inspect
import pickle
import typing
from typing import Any, ClassVar  # noqa: F401 - annotations name it

import pytest

from lifecycle import dataclasses as ours


@ours.dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Not made here, so that its methods are."""

    x: int
    names: tuple[str, ...] = ()
    seen: list[int] = ours.field(default_factory=list, compare=False)
    origin: int = ours.field(default=7, init=False)

    def __post_init__(self) -> None:
        if self.x < 0:
            raise ValueError(self.x)


def _make(decorators: Any) -> tuple[Any, Any]:
    """Return a base and a class that extends it, by one of the two modules."""

    @decorators.dataclass(frozen=True, slots=True, kw_only=True)
    class Base:
        x: int
        names: tuple[str, ...] = ()

    @decorators.dataclass(frozen=True, slots=True, kw_only=True)
    class Extended(Base):
        seen: list[int] = decorators.field(default_factory=list, hash=False)
        text: str = decorators.field(default="as ever", repr=False)
        fixed: int = decorators.field(default=3, init=False)

    return Base, Extended


def test_they_behave_as_the_standard_librarys() -> None:
    found = []
    for module in (ours, standard):
        base, extended = _make(module)
        one, other = extended(x=1), extended(x=1, seen=[2])
        with pytest.raises(module.FrozenInstanceError) as assigned:
            one.x = 2
        with pytest.raises(module.FrozenInstanceError) as deleted:
            del one.x
        with pytest.raises(TypeError) as missing:
            extended(names=())
        found.append(
            (
                repr(one).rpartition(".")[2],
                repr(other).rpartition(".")[2],
                one == extended(x=1),
                one == other,
                one != base(x=1),
                hash(one) == hash(other),
                hash(one) == hash(extended(x=2)),
                module.replace(one, x=5).x,
                copy.deepcopy(other) == other,
                str(assigned.value),
                str(deleted.value),
                str(missing.value).rpartition(".")[2],
                list(inspect.signature(extended).parameters),
                extended.__match_args__,
                extended.__slots__,
                [each.name for each in module.fields(extended)],
            )
        )
    assert found[0] == found[1]


@pytest.mark.parametrize("options", [{}, {"eq": False}, {"frozen": True, "eq": False}])
def test_who_may_be_hashed_is_as_in_the_standard_library(options: dict[str, bool]) -> None:
    def hashes(module: Any) -> tuple[bool, bool]:
        @module.dataclass(slots=True, **options)
        class One:
            x: int

        return One.__hash__ is None, One.__hash__ is object.__hash__

    assert hashes(ours) == hashes(standard)


def test_either_kind_extends_the_other() -> None:
    for first, second in ((ours, standard), (standard, ours)):
        base, _ = _make(first)
        derived = second.dataclass(frozen=True, slots=True, kw_only=True)(
            type("Derived", (base,), {"__annotations__": {"more": "int"}})
        )
        made = derived(x=1, more=2)
        assert (made.x, made.more, made == derived(x=1, more=2)) == (1, 2, True)
        with pytest.raises(standard.FrozenInstanceError):
            made.more = 3


def test_a_method_is_made_when_it_is_first_used() -> None:
    base, _ = _make(ours)
    assert {type(vars(base)[name]).__name__ for name in ("__init__", "__eq__")} == {"_Method"}
    base(x=1)
    assert inspect.isfunction(vars(base)["__init__"])
    assert type(vars(base)["__eq__"]).__name__ == "_Method"


def test_what_a_class_does_itself_stays() -> None:
    assert pickle.loads(pickle.dumps(Point(x=1, seen=[3]))).seen == [3]
    assert Point(x=1).origin == 7
    with pytest.raises(ValueError, match="-1"):
        Point(x=-1)
    assert hash(Point(x=1, seen=[1])) == hash(Point(x=1))


def _variants(module: Any) -> list[Any]:
    """Return classes whose annotations or defaults are not plain fields, and what extends them."""
    made: list[Any] = []
    for annotated, defaults in (
        ({"x": "int", "shared": f"{typing.__name__}.ClassVar[int]"}, {"shared": 4}),
        ({"x": "int", "shared": "ClassVar[int]"}, {"shared": 4}),
        ({"x": "int", "shared": "ClassVar[int]", "other": "ClassVar[str]"}, {"shared": [4]}),
        ({"x": "int", "shared": "ClassVar[int]", "_": "standard.KW_ONLY", "y": "int"}, {"y": 2}),
        ({"x": "int", "y": "ClassVarious"}, {"y": 3}),
        ({"x": int, "y": "str"}, {"y": "text"}),
        ({"x": "int", "_": "standard.KW_ONLY", "y": "int"}, {"y": 2}),
        ({"x": "int", "y": "int"}, {"y": module.field(default=3, compare=False, kw_only=True)}),
    ):
        body = {"__annotations__": annotated, "__module__": __name__, **defaults}
        base = module.dataclass(frozen=True, slots=True)(type("Variant", (), dict(body)))
        again = {"__annotations__": {"x": "float", "z": "int"}, "z": 5}
        derived = module.dataclass(frozen=True, slots=True)(type("Derived", (base,), again))
        made += [base, derived]
    return made


def test_annotations_mean_what_they_mean_to_the_standard_library() -> None:
    def looked_at(cls: Any) -> tuple[Any, ...]:
        one = cls(x=1)
        return (
            [(each.name, str(each.type), each.kw_only) for each in standard.fields(cls)],
            [(name, str(each._field_type)) for name, each in cls.__dataclass_fields__.items()],
            [str(each) for each in inspect.signature(cls).parameters.values()],
            (cls.__slots__, cls.__match_args__, getattr(one, "shared", None)),
            (repr(one), one == cls(x=1), hasattr(one, "__dict__")),
        )

    ours_, theirs = _variants(ours), _variants(standard)
    assert [looked_at(each) for each in ours_] == [looked_at(each) for each in theirs]


@pytest.mark.parametrize("name", ["default", "unannotated", "__slots__"])
def test_what_the_standard_library_refuses_is_refused(name: str) -> None:
    messages = []
    for module in (ours, standard):
        body: dict[str, Any] = {"__annotations__": {"x": "list[int]"}, "__module__": __name__}
        body |= {
            "default": {"x": []},
            "unannotated": {"y": module.field(default=1)},
            "__slots__": {"__slots__": ("z",)},
        }[name]
        with pytest.raises((TypeError, ValueError)) as refused:
            module.dataclass(frozen=True, slots=True)(type("Wrong", (), body))
        messages.append(str(refused.value))
    assert messages[0] == messages[1]
