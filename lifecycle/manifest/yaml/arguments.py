"""Launch-like arguments of a manifest and `$(arg …)`, `$(env …)` substitutions in its values.

Owns: `$(arg NAME)`, `$(env NAME [DEFAULT])`, `$$(` for a literal `$(`, and where argument values
are taken from: given as `name:=value`, else the default. A substitution never adds structure: its
text is never parsed as YAML again, it only takes the type of a scalar where it is one whole
unquoted value. Pure; the environment is injected.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping

from lifecycle.errors import LifecycleError
from lifecycle.manifest.diagnostics import Diagnostic
from lifecycle.manifest.schema import did_you_mean
from lifecycle.manifest.yaml.document import Cursor, Document, Place, Scalar, Value, error
from lifecycle.manifest.yaml.yaml_parser import MAX_FINDINGS, quote, resolve

MAX_TEXT = 1 << 20
"""Characters that the substitutions of one document may produce."""

_PIECE = re.compile(r"\$(\$\()|\$\(([^()]*)(\)?)")
_WORDS = re.compile(r"\s*(\S+)(?:\s+(\S+)(?:\s(.*))?)?\Z", re.DOTALL)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_ALLOWED = "write $(arg NAME), $(env NAME) or $(env NAME DEFAULT); $$( is a literal $("


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Substituted:
    """A document without substitutions.

    Attributes:
        arguments: (name, value) in the order of declaration.
        broken: values that could not be substituted; they are reported in `diagnostics` and stay
            in `document` as written.
    """

    document: Document
    arguments: tuple[tuple[str, str], ...]
    diagnostics: tuple[Diagnostic, ...]
    broken: tuple[Place, ...]


def substitute(
    document: Document,
    given: Mapping[str, str],
    environment: Mapping[str, str],
    *,
    include: Cursor | None = None,
) -> Substituted:
    """Resolve a document's arguments, then every substitution in its values.

    Args:
        document: as read, not yet validated; what is malformed in `arguments:` is passed over, the
            schema reports it.
        given: values by argument name, from the command line or from an including manifest.
        environment: what `$(env NAME)` sees.
        include: the entry of the including manifest that gives the values.
    """
    work = _Substitution(document, environment, include)
    work.resolve_arguments(given)
    root = document.root
    assert isinstance(root.data, Mapping)
    data = {
        key: value if key == "arguments" else work.value(value, (key,))
        for key, value in root.data.items()
    }
    return Substituted(
        document=dataclasses.replace(document, root=dataclasses.replace(root, data=data)),
        arguments=tuple(work.values.items()),
        diagnostics=tuple(work.found),
        broken=tuple(work.broken),
    )


class _Substitution:
    """One run over one document."""

    def __init__(
        self, document: Document, environment: Mapping[str, str], include: Cursor | None
    ) -> None:
        self.values: dict[str, str] = {}
        self.found: list[Diagnostic] = []
        self.broken: list[Place] = []
        self._document = document
        self._environment = environment
        self._include = include
        self._declared: tuple[str, ...] = ()
        self._settled: set[str] = set()
        self._room = MAX_TEXT

    def resolve_arguments(self, given: Mapping[str, str]) -> None:
        """Settle the value of each declared argument, in order; report what is wrong with any."""
        section = self._document.find(("arguments",))
        declared = section.data if section and isinstance(section.data, Mapping) else {}
        self._declared = tuple(declared)
        for name in given:
            if name not in declared:
                known = (
                    f"declared: {', '.join(declared)}" if declared else "the manifest declares none"
                )
                message = f"cannot set the argument {quote(name)}; {known}"
                at = self._document.key_at(("arguments",))
                if self._include:
                    owner = self._include
                    at = owner.document.key_at((*owner.place, "arguments", name))
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
            self.values[name] = value
            self._check_choice(name, value, place)

    def _default(self, name: str, place: Place) -> str | None:
        default = self._document.find((*place, "default"))
        entry = self._document.find(place)
        keys = entry.data if entry and isinstance(entry.data, Mapping) else {"?": None}
        if default is None and not set(keys) <= {"description", "choices"}:
            return None
        if default is None:
            about = self._document.find((*place, "description"))
            what = f" ({about.data})" if about and isinstance(about.data, str) else ""
            message = f"cannot do without a value for the argument {name!r}{what}"
            hint = f"give {name}:=VALUE on the command line, or a default here"
            if self._include:
                at = self._include.at
                hint = f"add it to the arguments of the include at {at.file}:{at.line}:{at.column}"
            where = self._document.key_at(place)
            self.found.append(error("manifest.missing-argument", where, message, hint))
            return None
        if isinstance(default.data, (tuple, Mapping)) or default.data is None:
            return None
        resolved = self.value(default, (*place, "default"))
        return None if (*place, "default") in self.broken else resolved.text

    def _check_choice(self, name: str, value: str, place: Place) -> None:
        choices = self._document.find((*place, "choices"))
        if choices is None or not isinstance(choices.data, tuple) or not choices.data:
            return
        allowed = [each.text for each in choices.data]
        if value not in allowed:
            self._report(
                "manifest.argument-choice",
                place,
                f"cannot set {name} to {quote(value)}; allowed: {', '.join(allowed)}",
                did_you_mean(value, allowed),
            )

    def value(self, value: Value, place: Place) -> Value:
        """Return `value` with every substitution inside it resolved."""
        if isinstance(value.data, tuple):
            items = tuple(
                self.value(each, (*place, index)) for index, each in enumerate(value.data)
            )
            return dataclasses.replace(value, data=items)
        if isinstance(value.data, Mapping):
            entries = {key: self.value(each, (*place, key)) for key, each in value.data.items()}
            return dataclasses.replace(value, data=entries)
        if "$" not in value.text:
            return value
        if len(self.found) > MAX_FINDINGS:
            self.broken.append(place)
            return value
        return self._scalar(value, place)

    def _scalar(self, value: Value, place: Place) -> Value:
        try:
            text = _PIECE.sub(lambda match: self._piece(match, place), value.text)
            self._spend(text)
            whole = _PIECE.fullmatch(value.text)
            data: Scalar = text
            # An empty string stays one, instead of becoming null.
            if whole and not whole[1] and not value.quoted and text:
                data = resolve(text)
        except LifecycleError as problem:
            if problem.message:
                self._report("manifest.substitution", place, problem.message, problem.hint)
        except ValueError as problem:
            self._report("yaml.number", place, f"cannot use {quote(text)}: {problem}")
        else:
            return dataclasses.replace(value, data=data, text=text)
        self.broken.append(place)
        return value

    def _spend(self, text: str) -> None:
        if not _encodable(text):
            raise LifecycleError(f"cannot use {quote(text)}: it is not UTF-8")
        exhausted = self._room < 0
        self._room -= len(text)
        if self._room < 0:
            message = f"cannot substitute more than {MAX_TEXT} characters in one document"
            raise LifecycleError("" if exhausted else message)

    def _piece(self, match: re.Match[str], place: Place) -> str:
        """Return the text of one `$(…)`.

        Raises:
            LifecycleError: why there is none; without message where that is already reported.
        """
        if match[1]:
            return "$("
        words = _WORDS.match(match[2].strip())
        kind, name, default = words.groups() if words else (None, None, None)
        if match[3] and name and _NAME.match(name):
            if kind == "env":
                return self._variable(name, default)
            if kind == "arg" and default is None:
                return self._argument(name, place)
            if kind == "arg":
                raise LifecycleError(
                    f"cannot give a default in {quote(match[0])}",
                    hint=f"declare it: arguments: {{{name}: {{default: …}}}}",
                )
        raise LifecycleError(f"cannot substitute {quote(match[0])}", hint=_ALLOWED)

    def _variable(self, name: str, default: str | None) -> str:
        found = self._environment.get(name, default)
        if found is None:
            raise LifecycleError(
                f"cannot find the environment variable {name!r}",
                hint=f"set it, or write $(env {name} DEFAULT)",
            )
        return found

    def _argument(self, name: str, place: Place) -> str:
        if name in self.values:
            return self.values[name]
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
        self.found.append(error(rule, self._document.at(place), message, hint))


def _encodable(text: str) -> bool:
    """Whether text from outside holds no half characters, as undecodable bytes leave them."""
    return not any("\ud800" <= character <= "\udfff" for character in text)
