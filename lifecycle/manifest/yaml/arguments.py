"""Launch-like arguments of a manifest, substitutions in its values, and `if:` and `unless:`.

Owns: where argument values are taken from; which nodes, includes and groups a document leaves out
by their conditions, whose other substitutions are then not looked at; what a value becomes. A
substitution never adds structure: its text only takes the type of a scalar where it is one whole
unquoted value.
"""

from __future__ import annotations

from collections.abc import Mapping

from msgspec.structs import replace

from lifecycle.errors import LifecycleError, did_you_mean
from lifecycle.manifest.diagnostics import Diagnostic, error, warning
from lifecycle.manifest.yaml.document import (
    Document,
    Place,
    Scalar,
    Value,
    quote,
    resolve,
)
from lifecycle.manifest.yaml.source import MAX_FINDINGS
from lifecycle.manifest.yaml.substitutions import (
    NotRunError,
    Substitution,
    Surroundings,
    Text,
    decide,
    parse_text,
    truth,
)

MAX_TEXT = 1 << 20
"""Characters that the substitutions of one document may produce."""

CONDITIONS = ("if", "unless")

_ARGV = ("command", "prefix")
"""Lists that are kept although a program that is not run would write one of their words."""


def substitute(
    document: Document,
    given: Mapping[str, str],
    surroundings: Surroundings,
    *,
    include: Document | None = None,
) -> Substituted:
    """Resolve a document's arguments, then every substitution in its values.

    Args:
        document: as read; what is malformed in its `arguments:` is left to the schema.
        given: values by argument name, from the command line or from an including manifest.
        surroundings: what substitutions read from outside.
        include: the entry of the including manifest that gives the values.
    """
    substituted = Substituted(document, surroundings, include)
    substituted.resolve_arguments(given)
    substituted.document = replace(document, root=substituted.value(document.root))
    return substituted


def _may_have_conditions(place: Place) -> bool:
    """Whether a node, an include or a group is there, of the document or of a group in it."""
    while len(place) > 2 and place[0] == "groups":
        place = place[2:]
    return len(place) == 2 and place[0] in ("nodes", "include", "groups")


class Substituted:
    """A document without substitutions.

    Attributes:
        arguments: values by name, in the order of declaration.
        found: what is wrong.
        broken: values that could not be substituted, and what has a condition that could not be
            read; they are in `found` and stay in `document` as written.
        left_out: nodes, includes and groups whose condition does not hold. Nodes are no longer in
            `document`; the others are, as written, so that those after them keep their numbers.
    """

    def __init__(
        self, document: Document, surroundings: Surroundings, include: Document | None
    ) -> None:
        self.document = document
        self.arguments: dict[str, str] = {}
        self.found: list[Diagnostic] = []
        self.broken: list[Place] = []
        self.left_out: dict[Place, None] = {}
        self._open: set[Place] = set()
        self._surroundings = surroundings
        self._include = include
        self._declared: tuple[str, ...] = ()
        self._settled: set[str] = set()
        self._room = MAX_TEXT

    def resolve_arguments(self, given: Mapping[str, str]) -> None:
        """Settle the value of each declared argument, in order; report what is wrong with any."""
        section = self.document.find(("arguments",))
        declared = section.data if section and isinstance(section.data, Mapping) else {}
        self._declared = tuple(declared)
        for name in given:
            if name not in declared:
                known = (
                    f"declared: {', '.join(declared)}" if declared else "the manifest declares none"
                )
                message = f"cannot set the argument {quote(name)}; {known}"
                at = self.document.key_at(("arguments",))
                if self._include:
                    at = self._include.key_at(("arguments", name))
                hint = did_you_mean(name, declared)
                self.found.append(error("manifest.unknown-argument", at, message, hint))
        for name in declared:
            place: Place = ("arguments", name)
            value = given[name] if name in given else self._default(name, place)
            self._settled.add(name)
            if value is None:
                continue
            if not _encodable(value):
                message = f"cannot set {name} to {quote(value)}: it is not UTF-8"
                self._report("manifest.substitution", place, message)
                continue
            self.arguments[name] = value
            choices = self.document.find((*place, "choices"))
            allowed = (
                [each.text for each in choices.data]
                if choices and isinstance(choices.data, tuple)
                else []
            )
            if allowed and value not in allowed:
                message = f"cannot set {name} to {quote(value)}; allowed: {', '.join(allowed)}"
                hint = did_you_mean(value, allowed)
                self._report("manifest.argument-choice", place, message, hint)

    def _default(self, name: str, place: Place) -> str | None:
        default = self.document.find((*place, "default"))
        entry = self.document.find(place)
        keys = entry.data if entry and isinstance(entry.data, Mapping) else {"?": None}
        if default is None and not set(keys) <= {"description", "choices"}:
            return None
        if default is None:
            about = self.document.find((*place, "description"))
            what = f" ({about.data})" if about and isinstance(about.data, str) else ""
            message = f"cannot do without a value for the argument {name!r}{what}"
            hint = f"give {name}:=VALUE on the command line, or a default here"
            if self._include:
                hint = f"add it to the arguments of the include at {self._include.at().spelled}"
            where = self.document.key_at(place)
            self.found.append(error("manifest.missing-argument", where, message, hint))
            return None
        if isinstance(default.data, (tuple, Mapping)) or default.data is None:
            return None
        resolved = self.value(default, (*place, "default"))
        return None if (*place, "default") in self.broken else resolved.text

    def _leave_open(self, place: Place, problem: LifecycleError) -> None:
        """Leave a value out that a program would write; what must be there is an error."""
        if "arguments" in place[:1] or place[-1] in CONDITIONS:
            self._report("manifest.command-not-run", place, problem.message, problem.hint)
            self.broken.append(place)
            return
        self._open.add(place)
        at = self.document.at(place)
        self.found.append(warning("manifest.command-not-run", at, problem.message, problem.hint))

    def _conditions(self, value: Value, place: Place) -> Value | None:
        """Return a value with its conditions read, which may be `broken`; None if left out."""
        if not isinstance(value.data, Mapping):
            return value
        known: dict[str, Value] = {}
        for key in CONDITIONS:
            if key not in value.data:
                continue
            at, message = (*place, key), "cannot use if and unless together"
            hint = "write if: $(and A $(not B))"
            each = self.value(value.data[key], at)
            if at in self.broken:
                self.broken[-1] = place
                return value
            holds = None if isinstance(each.data, (tuple, Mapping)) else truth(each.text)
            if holds is None:
                message = f"cannot use {key} {quote(each.plain())}; allowed: true, false, 1, 0"
                hint = "write $(equals A B), $(not A), $(and A B) or $(or A B)"
            if holds is None or known:
                self._report("manifest.condition", at, message, hint)
                self.broken.append(place)
                return value
            known[key] = replace(each, data=holds)
        if any(each.data is not (key == "if") for key, each in known.items()):
            self.left_out[place] = None
            return None
        return replace(value, data={**value.data, **known}) if known else value

    def value(self, value: Value, place: Place = ()) -> Value:
        """Return `value` with every substitution inside it resolved, and no node that is left out.

        Whatever else is left out stays as it is written, and so does `arguments:`.
        """
        done: tuple[str, ...] = () if place else ("arguments",)
        if _may_have_conditions(place):
            known = self._conditions(value, place)
            if known is None or place in self.broken:
                return value
            value, done = known, CONDITIONS
        if isinstance(value.data, tuple):
            items = tuple(
                self.value(each, (*place, index)) for index, each in enumerate(value.data)
            )
            if place[-1] not in _ARGV and any((*place, i) in self._open for i in range(len(items))):
                self._open.add(place)
            return replace(value, data=items)
        if isinstance(value.data, Mapping):
            entries = {
                key: each if key in done else self.value(each, (*place, key))
                for key, each in value.data.items()
            }
            return replace(
                value,
                data={
                    key: each
                    for key, each in entries.items()
                    if (*place, key) not in self._open and (*place, key) not in self.left_out
                },
            )
        if "$" not in value.text:
            return value
        if len(self.found) > MAX_FINDINGS:
            self.broken.append(place)
            return value
        return self._scalar(value, place)

    def _scalar(self, value: Value, place: Place) -> Value:
        text = ""
        try:
            parts = parse_text(value.text)
            text = self._text(parts, place)
            self._spend(text)
            data: Scalar = text
            # An empty string stays one, instead of becoming null.
            whole = len(parts) == 1 and isinstance(parts[0], Substitution)
            if whole and not value.quoted and text:
                data = resolve(text, place)
        except NotRunError as problem:
            self._leave_open(place, problem)
            return value
        except LifecycleError as problem:
            if problem.message:
                self._report("manifest.substitution", place, problem.message, problem.hint)
        except ValueError as problem:
            self._report("yaml.number", place, f"cannot use {quote(text)}: {problem}")
        else:
            return replace(value, data=data, text=text)
        self.broken.append(place)
        return value

    def _spend(self, text: str) -> None:
        if not _encodable(text):
            raise LifecycleError(f"cannot use {quote(text)}: it is not UTF-8")
        exhausted, self._room = self._room < 0, self._room - len(text)
        if self._room < 0:
            message = f"cannot substitute more than {MAX_TEXT} characters in one document"
            raise LifecycleError("" if exhausted else message)

    def _text(self, parts: Text, place: Place) -> str:
        return "".join(
            each if isinstance(each, str) else self._substituted(each, place) for each in parts
        )

    def _substituted(self, each: Substitution, place: Place) -> str:
        """Return the text of one `$(…)`.

        Raises:
            LifecycleError: why there is none; without message where that is already reported.
        """
        if each.kind == "env":
            name, *default = each.words
            return self._variable(self._text(name, place), default, place)
        words = [self._text(word, place) for word in each.words]
        if each.kind == "arg":
            return self._argument(words[0], place)
        if each.kind == "command":
            return self._command(words, each.written)
        if each.kind == "find-pkg-share":
            return self._surroundings.package_share(words[0])
        if each.kind == "file":
            return self._surroundings.file(words[0])
        return quote(decide(each.kind, words, each.written))

    def _variable(self, name: str, default: list[Text], place: Place) -> str:
        found = self._surroundings.environment.get(name)
        if found is not None:
            return found
        if default:
            return self._text(default[0], place)
        raise LifecycleError(
            f"cannot find the environment variable {name!r}",
            hint=f"set it, or write $(env {name} DEFAULT)",
        )

    def _command(self, words: list[str], written: str) -> str:
        programs = self._surroundings.programs
        if programs is None:
            raise NotRunError(
                f"cannot say what {quote(written)} becomes: its program was not run",
                hint="give --run-commands if you trust this manifest",
            )
        return programs.output(words, self._surroundings.folder)

    def _argument(self, name: str, place: Place) -> str:
        if name in self.arguments:
            return self.arguments[name]
        if name not in self._declared:
            declared = ", ".join(self._declared)
            known = f"declared: {declared}" if declared else "none is declared"
            hint = did_you_mean(name, self._declared)
            raise LifecycleError(
                f"cannot find the argument {name!r}; {known}",
                hint=hint or f"declare it: arguments: {{{name}: {{}}}}",
            )
        if place[0] == "arguments" and name not in self._settled:
            raise LifecycleError(
                f"cannot use the argument {name!r} above its declaration", hint="move it up"
            )
        raise LifecycleError("")  # declared, without a value

    def _report(self, rule: str, place: Place, message: str, hint: str = "") -> None:
        if len(self.found) > MAX_FINDINGS:
            return
        if len(self.found) == MAX_FINDINGS:
            rule, hint = "manifest.too-many", "fix these first"
            message = f"cannot list more than {MAX_FINDINGS} findings"
        self.found.append(error(rule, self.document.at(place), message, hint))


def _encodable(text: str) -> bool:
    """Whether text from outside holds no half characters, as undecodable bytes leave them."""
    return not any("\ud800" <= character <= "\udfff" for character in text)
