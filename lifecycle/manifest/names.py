"""ROS names and remap rules: which names are legal, how they expand, and which rule applies.

Owns: the rules of rmw_validate_node_name, rmw_validate_namespace, rmw_validate_full_topic_name,
rcl_validate_topic_name, rcl_expand_topic_name and the order in which rcl applies them; the grammar
of a remap rule of `ros2 run … --ros-args -r RULE` (rcl/arguments.c, rcl/lexer.c):
`[node:][rostopic://|rosservice://]from:=to`, `[node:]__node:=name`, `[node:]__ns:=/namespace`. Also
the services that every node has, and the names that a supervisor has in ROS. Pure.
"""

from __future__ import annotations

import enum
import functools
import re
from collections.abc import Container, Iterable, Mapping

import msgspec

from lifecycle.errors import ExitCode, LifecycleError
from lifecycle.manifest.model import EndpointKind, NodeDeclaration, RosInterfaceAccess
from lifecycle.manifest.yaml.document import quote

# rcl's lexer: a token has no two underscores in a row and does not start with a digit.
_WORD = r"(?![0-9])(?:(?!__)[A-Za-z0-9_])+"
_NAME = re.compile(rf"(?:~/|/)?{_WORD}(?:/{_WORD})*", re.ASCII)
_NODE_PREFIX = re.compile(rf"({_WORD}):(?!//)(.*)", re.ASCII | re.DOTALL)
_ONE_WORD = re.compile(_WORD, re.ASCII)
_NAMESPACE = re.compile(rf"/|(?:/{_WORD})+", re.ASCII)


class RemapKind(enum.Flag):
    """What a rule may rename; a plain `from:=to` renames topics and services alike."""

    TOPIC = enum.auto()
    SERVICE = enum.auto()
    NODE_NAME = enum.auto()
    NAMESPACE = enum.auto()


def remap_kind(kind: EndpointKind) -> RemapKind:
    """Return which rules rename an endpoint of a topic or service."""
    return RemapKind.TOPIC if kind.is_topic else RemapKind.SERVICE


class NameNotLegalError(LifecycleError):
    """A name that no ROS node can use, or a remap rule that rcl refuses."""

    exit_code = ExitCode.MANIFEST_INVALID


class RemapRule(msgspec.Struct, frozen=True, kw_only=True):
    """One rule.

    Attributes:
        node: base name of the only node it is for; empty for every node.
        match: name it replaces, not yet expanded; empty for node name and namespace rules.
        replacement: what takes its place, not yet expanded.
    """

    kind: RemapKind
    node: str
    match: str
    replacement: str

    def applies_to(self, kind: RemapKind, node_name: str) -> bool:
        """Whether rcl looks at this rule at all for a name of `kind` in node `node_name`."""
        return bool(self.kind & kind) and self.node in ("", node_name)


@functools.lru_cache(maxsize=1 << 12)
def parse_rule(match: str, replacement: str) -> RemapRule:
    """Read the two sides of `match:=replacement`; NameNotLegalError if rcl would refuse it."""
    node, rest = "", match
    if prefix := _NODE_PREFIX.fullmatch(match):
        node, rest = prefix[1], prefix[2]
    if rest in ("__node", "__name"):
        _require(_ONE_WORD, replacement, "a node name, as in '__node:=camera'")
        return RemapRule(kind=RemapKind.NODE_NAME, node=node, match="", replacement=replacement)
    if rest == "__ns":
        _require(_NAMESPACE, replacement, "an absolute namespace, as in '__ns:=/robot'")
        return RemapRule(kind=RemapKind.NAMESPACE, node=node, match="", replacement=replacement)
    kind = RemapKind.TOPIC | RemapKind.SERVICE
    for scheme, only in (("rostopic://", RemapKind.TOPIC), ("rosservice://", RemapKind.SERVICE)):
        if rest.startswith(scheme):
            kind, rest = only, rest[len(scheme) :]
    if "*" in rest:
        raise NameNotLegalError(f"cannot remap {match!r}: rcl has no wildcards in remap rules")
    _require(_NAME, rest, "a name, as in 'scan', '~/scan' or '/robot/scan'")
    _require(_NAME, replacement, "a name, as in 'scan', '~/scan' or '/robot/scan'")
    return RemapRule(kind=kind, node=node, match=rest, replacement=replacement)


def _require(pattern: re.Pattern[str], text: str, what: str) -> None:
    if pattern.fullmatch(text):
        return
    why = "rcl allows no '__' there" if "__" in text else f"it must be {what}"
    raise NameNotLegalError(f"cannot use {text!r} in a remap rule: {why}")


MAX_TOPIC_LENGTH = 247
"""RMW_TOPIC_MAX_NAME_LENGTH: 255 less 8 that are reserved for prefixes."""

MAX_NAMESPACE_LENGTH = MAX_TOPIC_LENGTH - 2
"""RMW_NAMESPACE_MAX_LENGTH: room for `/` and a name of one character."""

MAX_NODE_NAME_LENGTH = 255
"""RMW_NODE_NAME_MAX_NAME_LENGTH."""

_OF_ACTIONS = (
    *((each, EndpointKind.SERVICE_SERVER) for each in ("send_goal", "cancel_goal", "get_result")),
    *((each, EndpointKind.PUBLISHER) for each in ("feedback", "status")),
)
"""Services and topics under `<action>/_action/` (rcl_action/names.h)."""

_NOT_IN = {"": re.compile(r"[^A-Za-z0-9_]"), "/": re.compile(r"[^A-Za-z0-9_/]")}
_SUBSTITUTION = re.compile(r"\{([^{}]*)\}")
_KNOWN_SUBSTITUTIONS = ("node", "ns", "namespace")


def node_name_problem(name: str) -> str:
    """Return why `name` is no node name, as a phrase; empty if it is legal."""
    length = len(name)
    return _first(
        (not name, "a node name must not be empty"),
        (_odd(name, ""), f"a node name holds letters, digits and '_' only{_odd(name, '')}"),
        (name[:1].isdigit(), "a node name must not start with a digit"),
        (
            length > MAX_NODE_NAME_LENGTH,
            f"a node name has at most {MAX_NODE_NAME_LENGTH} characters, this one {length}",
        ),
    )


def namespace_problem(namespace: str) -> str:
    """Return why `namespace` is no namespace of a node; empty if it is legal."""
    if namespace == "/":
        return ""
    return _absolute_problem(namespace, "a namespace", MAX_NAMESPACE_LENGTH)


def full_name_problem(name: str) -> str:
    """Return why `name` is no fully qualified topic or service name; empty if it is legal."""
    return _absolute_problem(name, "a fully qualified name", MAX_TOPIC_LENGTH)


def name_problem(name: str) -> str:
    """Return why `name` cannot name a topic, service or action in a node's code; empty if legal.

    Relative, absolute and `~/private` names and rcl's substitutions (`{node}`, `{ns}`) are legal.
    """
    plain = _SUBSTITUTION.sub("", name)
    unknown = [each for each in _SUBSTITUTION.findall(name) if each not in _KNOWN_SUBSTITUTIONS]
    known = ", ".join(f"'{{{each}}}'" for each in _KNOWN_SUBSTITUTIONS)
    odd = _odd(plain[1:] if plain[:1] == "~" else plain, "/")
    return _first(
        (not name, "a name must not be empty"),
        (name.endswith("/"), "a name must not end with '/'"),
        ("~" in name[1:], "'~' may only be the first character of a name"),
        (
            name[:1] == "~" and name[1:2] not in ("", "/"),
            f"'~' must be followed by '/', as in '~/{name[1:]}'",
        ),
        (
            "{" in plain or "}" in plain,
            "braces must be paired and not nested, as in '{node}/status'",
        ),
        (unknown, f"there is no substitution '{{{''.join(unknown[:1])}}}'; rcl knows {known}"),
        (odd, f"a name holds letters, digits, '_' and '/' only{odd}"),
        (_digit_first(name), "no part of a name may start with a digit"),
    )


def free_name(name: str, taken: Container[str]) -> str:
    """Return a name that is not taken: `name`, or `name_2`, `name_3`, … where it is."""
    free, number = name, 2
    while free in taken:
        free, number = f"{name}_{number}", number + 1
    return free


@functools.lru_cache(maxsize=1 << 16)  # every check of a large system asks again
def expand(name: str, node_name: str, namespace: str) -> str:
    """Return the fully qualified form of `name`, before remapping, as rcl_expand_topic_name.

    Raises:
        NameNotLegalError: the name, the node's name or its namespace is not legal, or the result
            is not (two slashes in a row, too long).
    """
    checks = (
        (name, name_problem(name)),
        (node_name, node_name_problem(node_name)),
        (namespace, namespace_problem(namespace)),
    )
    for value, problem in checks:
        if problem:
            raise NameNotLegalError(f"cannot use {quote(value)} as a name: {problem}")
    prefix = namespace.rstrip("/")
    expanded = f"{prefix}/{node_name}{name[1:]}" if name[0] == "~" else name
    values = {"node": node_name, "ns": namespace, "namespace": namespace}
    expanded = _SUBSTITUTION.sub(lambda match: values[match[1]], expanded)
    if not expanded.startswith("/"):
        expanded = f"{prefix}/{expanded}"
    if problem := full_name_problem(expanded):
        becomes = "" if expanded == name else f", which expands to {quote(expanded)}"
        raise NameNotLegalError(f"cannot use {quote(name)}{becomes}: {problem}")
    return expanded


def resolve(
    name: str,
    *,
    node_name: str,
    namespace: str,
    remap: Iterable[tuple[str, str]] = (),
    kind: EndpointKind = EndpointKind.PUBLISHER,
) -> str:
    """Return the fully qualified name that an endpoint has in the graph.

    The name is expanded, then the first rule whose expanded `from` equals it replaces it
    (rcl_remap_name); a replacement is not remapped again. rcl of ROS 2 Jazzy remaps an action's
    hidden topics and services one by one, never the action, so an action is renamed exactly when
    rules give all its hidden names one new action name.

    Args:
        name: as declared.
        node_name: base name of the node.
        namespace: absolute.
        remap: (from, to) as written, in order.
        kind: decides whether `rostopic://` or `rosservice://` rules apply.

    Raises:
        NameNotLegalError: a name or a rule is not legal, or the rules tear an action apart.
    """
    rules = [parse_rule(match, replacement) for match, replacement in remap]
    expanded = expand(name, node_name, namespace)

    def remapped(name: str, kind: EndpointKind) -> str:
        for rule in rules:
            if (
                rule.applies_to(remap_kind(kind), node_name)
                and expand(rule.match, node_name, namespace) == name
            ):
                return expand(rule.replacement, node_name, namespace)
        return name

    if not kind.is_action:
        return remapped(expanded, kind)
    return action_of(name, {each: remapped(each, of) for each, of in hidden_names(expanded)})


def name_in_graph(node: NodeDeclaration, name: str, kind: EndpointKind) -> str:
    """Return what `resolve` says of an endpoint of a node, or raise its NameNotLegalError."""
    return resolve(name, node_name=node.name, namespace=node.namespace, remap=node.remap, kind=kind)


def topic_of(node: NodeDeclaration, name: str, kind: EndpointKind) -> str:
    """Return `name_in_graph`; empty if a name is not legal, which checks report."""
    try:
        return name_in_graph(node, name, kind)
    except LifecycleError:
        return ""


def hidden_names(action: str) -> tuple[tuple[str, EndpointKind], ...]:
    """Return names and kinds of what an action server really offers: services, then topics."""
    return tuple((f"{action}/_action/{each}", kind) for each, kind in _OF_ACTIONS)


def action_of(name: str, resolved: Mapping[str, str]) -> str:
    """Return what an action is called whose five hidden names were resolved one by one.

    Raises:
        NameNotLegalError: they belong to different actions.
    """
    actions = {}
    for hidden, full_name in resolved.items():
        action, _, last = full_name.rpartition("/_action/")
        actions[hidden] = action if last == hidden.rpartition("/")[2] else full_name
    if len(set(actions.values())) > 1:
        torn = ", ".join(f"{hidden} → {action}" for hidden, action in actions.items())
        raise NameNotLegalError(
            f"cannot remap only some of action {name!r}'s hidden names: {torn}",
            hint="remap all five to one action name, or none",
        )
    return next(iter(actions.values()))


def _absolute_problem(name: str, what: str, longest: int) -> str:
    odd = _odd(name, "/")
    return _first(
        (not name, f"{what} must not be empty"),
        (not name.startswith("/"), f"{what} must start with '/'"),
        (name.endswith("/"), f"{what} must not end with '/'"),
        (odd, f"{what} holds letters, digits, '_' and '/' only{odd}"),
        ("//" in name, f"{what} must not hold two '/' in a row"),
        (_digit_first(name), f"no part of {what} may start with a digit"),
        (len(name) > longest, f"{what} has at most {longest} characters, this one {len(name)}"),
    )


def _first(*checks: tuple[object, str]) -> str:
    """Return the sentence of the first check that fired; empty if none did."""
    return next((sentence for fired, sentence in checks if fired), "")


def _digit_first(name: str) -> bool:
    return any(part[:1].isdigit() for part in name.split("/"))


def _odd(text: str, allowed: str) -> str:
    """Name the first character outside `[A-Za-z0-9_]` and `allowed`; empty if none is."""
    found = _NOT_IN[allowed].search(text)
    return f", not {found[0]!r}" if found else ""


NODE_SERVICES: Mapping[str, str] = {
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "get_parameters": "rcl_interfaces/srv/GetParameters",
    "list_parameters": "rcl_interfaces/srv/ListParameters",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
    "get_type_description": "type_description_interfaces/srv/GetTypeDescription",
    "get_logger_levels": "rcl_interfaces/srv/GetLoggerLevels",
    "set_logger_levels": "rcl_interfaces/srv/SetLoggerLevels",
    "change_state": "lifecycle_msgs/srv/ChangeState",
    "get_state": "lifecycle_msgs/srv/GetState",
    "get_available_states": "lifecycle_msgs/srv/GetAvailableStates",
    "get_available_transitions": "lifecycle_msgs/srv/GetAvailableTransitions",
    "get_transition_graph": "lifecycle_msgs/srv/GetAvailableTransitions",
}
"""Services that client libraries offer under a node's own name, `~/get_state`, and their types."""

MANAGED_SERVICES = frozenset(
    name for name, type_ in NODE_SERVICES.items() if type_.startswith("lifecycle_msgs/")
)
"""Those of them that managed nodes alone have."""

OUR_SERVICES: Mapping[str, str] = {
    "get_configuration": "std_srvs/srv/Trigger",
    "connect_to": "rcl_interfaces/srv/SetParameters",
    "map_to": "rcl_interfaces/srv/SetParameters",
    "disconnect": "rcl_interfaces/srv/SetParameters",
    "remap": "rcl_interfaces/srv/SetParameters",
}
"""Services that nodes of ours offer besides. The names are common and the types standard: a node
counts as ours only with the two that no other node has together (`verify.tool_filter.OURS_BY`)."""

DIAGNOSTICS_TOPIC = "/diagnostics"
SUPERVISORS = "/lifecycle/"
"""What the names of all status topics and services of supervisors begin with."""
SUPERVISOR_STATUS = "status"
MODE_SERVICE = "mode/"
"""What the names of services begin with, below a supervisor's prefix, that enter a mode."""
_READING = ("get_status",)
_ORDERING = ("pause", "resume", "restart", "down")


def supervisor_prefix(system: str, machine: str = "") -> str:
    """Return what the names of a supervisor's status topic and services begin with.

    `machine` is its own where nodes of the system run on several; else empty.
    """
    names = (system, machine) if machine else (system,)
    return SUPERVISORS + "/".join(each.replace("-", "_") for each in names)


def supervisor_status_topic(prefix: str) -> str:
    """Return the name of the status topic of the supervisor with a prefix."""
    return f"{prefix}/{SUPERVISOR_STATUS}"


def supervisor_alive_topic(system: str, machine: str) -> str:
    """Return the hidden topic on which the supervisor of a machine asserts its liveliness."""
    return f"/_lifecycle/{system.replace('-', '_')}/{machine}/alive"


def supervisor_services(access: RosInterfaceAccess, modes: Iterable[str] = ()) -> tuple[str, ...]:
    """Return the names, below its prefix, of a supervisor's services; of those for modes, too."""
    if access is RosInterfaceAccess.OFF:
        return ()
    if access is RosInterfaceAccess.READ_ONLY:
        return _READING
    # Names of ROS hold no "__" and do not end with "_".
    legal = (each for each in modes if "__" not in f"{each}_")
    return (*_READING, *_ORDERING, *(f"{MODE_SERVICE}{each}" for each in legal))
