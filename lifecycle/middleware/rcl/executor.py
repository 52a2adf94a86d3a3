"""A single-threaded executor for rclpy that keeps its wait set and its list of entities.

Owns: waiting for the entities of some nodes and calling their callbacks, one at a time, in rclpy's
order: tasks, waitables, timers, subscriptions, guard conditions, clients, services.

rclpy 7 makes a new wait set for each turn, asks each entity for its handle, its callback group and
its counts, and wakes itself twice for each callback, so that every callback costs two such turns:
6 µs for each service of a node, used or not. Here the lists are compared with those of the turn
before, and no thread has to be woken that is awake. What an `async def` callback awaits is looked
at again whenever a callback was called, as rclpy does by waking itself.
"""

from __future__ import annotations

import collections
import functools
import types
import typing
from collections.abc import Callable, Coroutine
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, ShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.subscription import Subscription
from rclpy.task import Task
from rclpy.waitable import NumberOfEntities, Waitable

_FOR_EVER_NS = -1
_SIMPLE_GROUPS = (MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup)
"""They let every entity be executed while no callback is running or suspended."""

Run = Callable[[Any], None]


def _event_handle(handler: EventHandler) -> Any:
    return handler._EventHandler__event  # noqa: SLF001 - rclpy has no other way to it


class _WaitList:
    """The entities of some nodes, and a wait set that has room for them.

    Args:
        present: as `_present` returned it.
        own: guard conditions of the executor.
        context: of the wait set; entities may have others.

    Attributes:
        present: what this was made for.
        simple: all callback groups are rclpy's own.
    """

    def __init__(self, present: list[Any], own: list[Any], context: Context) -> None:
        self.present = present
        self.simple = True
        self.events: list[EventHandler] = []
        self.waitables: list[Waitable] = []
        self.guards: list[Any] = []
        self._entered: list[tuple[Callable[[], Any], Callable[..., Any]]] = []
        self._entries: dict[str, list[tuple[Any, Any]]] = {
            kind: [] for kind in ("timer", "subscription", "guard_condition", "client", "service")
        }
        counts = NumberOfEntities()
        kind = ""
        for each in present:
            if isinstance(each, str):
                kind = each
                continue
            self.simple = self.simple and type(each.callback_group) in _SIMPLE_GROUPS
            if kind != "waitable":
                self._keep(each.handle, self._entries[kind], each)
            elif type(each) is EventHandler:
                if self._keep(_event_handle(each), [], each):
                    self.events.append(each)
            elif self._keep(each, [], each):
                self.waitables.append(each)
                counts += each.get_num_entities()
        self.guards = [entity for entity, _ in self._entries["guard_condition"]]
        for each in own:
            self._keep(each.handle, self._entries["guard_condition"], None)
        self._keep(context.handle, [], None)
        self.by_pointer = {
            kind: {handle.pointer: entity for entity, handle in entries}
            for kind, entries in self._entries.items()
        }
        sizes = {kind: len(entries) for kind, entries in self._entries.items()}
        self.wait_set = _rclpy.WaitSet(
            sizes["subscription"] + counts.num_subscriptions,
            sizes["guard_condition"] + counts.num_guard_conditions,
            sizes["timer"] + counts.num_timers,
            sizes["client"] + counts.num_clients,
            sizes["service"] + counts.num_services,
            len(self.events) + counts.num_events,
            context.handle,
        )
        self._adders = [
            (entity, getattr(self.wait_set, f"add_{kind}"), handle)
            for kind, entries in self._entries.items()
            for entity, handle in entries
        ]
        self.kinds = tuple(kind for kind, entries in self._entries.items() if entries)
        self._event_handles = [_event_handle(each) for each in self.events]

    def _keep(self, handle: Any, entries: list[tuple[Any, Any]], entity: Any) -> bool:
        """Have a handle waited for; returns false for one that is destroyed already."""
        try:
            with handle:
                pass
        except InvalidHandle:
            return False
        self._entered.append((handle.__enter__, handle.__exit__))
        entries.append((entity, handle))
        return True

    def wait(self, timeout_ns: int, can_execute: Callable[[Any], bool] | None) -> list[Any]:
        """Wait, and return the waitables that are ready; `by_pointer` has the others.

        Args:
            timeout_ns: negative for ever.
            can_execute: which entities to wait for; None for all.

        Raises:
            InvalidHandle: one of them was destroyed meanwhile.
        """
        entered = 0
        try:
            # They must not be destroyed while rcl waits for them; afterwards they may.
            for enter, _ in self._entered:
                enter()
                entered += 1
            wait_set = self.wait_set
            wait_set.clear_entities()
            for entity, add, handle in self._adders:
                if can_execute is None or entity is None or can_execute(entity):
                    add(handle)
            events: list[tuple[EventHandler, int]] = []
            add_event = wait_set.add_event
            for event, handle in zip(self.events, self._event_handles, strict=True):
                if can_execute is None or can_execute(event):
                    events.append((event, add_event(handle)))
            waitables = [
                each for each in self.waitables if can_execute is None or can_execute(each)
            ]
            for each in waitables:
                each.add_to_wait_set(wait_set)
            for guard in self.guards:
                if guard._executor_triggered:  # noqa: SLF001 - not handled yet
                    guard.trigger()
            wait_set.wait(timeout_ns)
            ready: list[Any] = []
            is_ready = wait_set.is_ready
            for event, index in events:
                if is_ready("event", index):
                    event._ready_to_take_data = True  # noqa: SLF001 - as its is_ready does
                    ready.append(event)
            ready += [each for each in waitables if each.is_ready(wait_set)]
            return ready
        finally:
            for _, leave in self._entered[:entered]:
                leave(None, None, None)


@typing.final
class NodeExecutor(SingleThreadedExecutor):  # type: ignore[misc]  # rclpy is not typed
    """Waits for the entities of its nodes and says which callback is next.

    Example:
        >>> executor = NodeExecutor(context=context)
        >>> executor.add_node(node)
        >>> while True:
        ...     executor.next_callback()()
    """

    def __init__(self, *, context: Context) -> None:
        super().__init__(context=context)
        self._tasks: list[tuple[Task, Any, Any]] = []
        self._due: collections.deque[Callable[[], None]] = collections.deque()
        self._list: _WaitList | None = None
        self._polled = False
        self._called = False
        self._refused = False
        self._runs: dict[str, Run] = {
            "timer": self._run_timer,
            "subscription": self._run_subscription,
            "guard_condition": self._run_guard,
            "client": self._run_client,
            "service": self._run_service,
        }

    def next_callback(self) -> Callable[[], None]:
        """Wait for what is next; returns what runs it, and raises what the callback raises.

        Raises:
            ShutdownException: the executor was shut down.
            ExternalShutdownException: the context was.
        """
        while not self._due:
            if self._tasks and not self._polled:
                self._polled = True
                with self._tasks_lock:
                    tasks = [each for each, _, _ in self._tasks]
                self._due.extend(functools.partial(self._step, each) for each in reversed(tasks))
                continue
            self._wait()
            self._polled = False
        return self._due.popleft()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """As rclpy's."""
        self._due.clear()
        self._list = None
        return bool(super().shutdown(timeout_sec))

    def _wait(self) -> None:
        """Note what is ready as due."""
        if self._is_shutdown:
            raise ShutdownException
        with self._tasks_lock:
            self._tasks = [
                each for each in self._tasks if not (each[0].done() or each[0].cancelled())
            ]
            suspended = bool(self._tasks)
        present = self._present()
        kept = self._list
        if kept is None or kept.present != present:
            own = [self._guard, self._sigint_gc]
            kept = self._list = _WaitList(present, own, self._context)
        choose = self.can_execute if suspended or self._refused or not kept.simple else None
        # What a callback did may be what a suspended one awaits.
        timeout_ns = 0 if suspended and self._called else _FOR_EVER_NS
        self._called = self._refused = False
        try:
            waitables = kept.wait(timeout_ns, choose)
        except InvalidHandle:
            self._list = None
            return
        if self._is_shutdown:
            raise ShutdownException
        if not self._context.ok():
            raise ExternalShutdownException
        for waitable in waitables:
            self._due.append(functools.partial(self._run_waitable, waitable))
        for kind in kept.kinds:
            found, run = kept.by_pointer[kind], self._runs[kind]
            for pointer in kept.wait_set.get_ready_entities(kind):
                entity = found.get(pointer)  # None: our own guard conditions
                if entity is not None:
                    if kind == "guard_condition":
                        entity._executor_triggered = True  # noqa: SLF001 - rcl has taken it
                    self._due.append(functools.partial(run, entity))

    def _present(self) -> list[Any]:
        """Return the entities of all nodes, each kind after its name."""
        present: list[Any] = []
        for node in self.get_nodes():
            present.append("timer")
            present += node._timers  # noqa: SLF001 - its public names are generators
            present.append("subscription")
            present += node._subscriptions  # noqa: SLF001
            present.append("guard_condition")
            present += node._guards  # noqa: SLF001
            present.append("client")
            present += node._clients  # noqa: SLF001
            present.append("service")
            present += node._services  # noqa: SLF001
            present.append("waitable")
            present += node._Node__waitables  # noqa: SLF001
        return present

    def _step(self, task: Task) -> None:
        """Run a task, or what of it can run now."""
        task()
        if task.done():
            self._called = True
            if (error := task.exception()) is not None:
                raise error

    def _begin(self, entity: Any) -> bool:
        self._called = True
        if entity.callback_group.beginning_execution(entity):
            return True
        self._refused = True
        return False

    def _take(self, entity: Any, take: Callable[..., Any], *arguments: Any) -> Any:
        """Take what made an entity ready; None if there is nothing, and its execution has ended."""
        taken = None
        try:
            with entity.handle:
                taken = take(*arguments)
        except InvalidHandle:
            pass  # a callback before it has destroyed it
        finally:
            if taken is None:
                entity.callback_group.ending_execution(entity)
        return taken

    def _call(
        self,
        entity: Any,
        callback: Callable[..., Any],
        *arguments: Any,
        then: Callable[[Any], None] | None = None,
    ) -> None:
        """Call back for an entity, and end its execution once the callback is over.

        Args:
            entity: whose execution has begun.
            callback: sync or async.
            arguments: its arguments.
            then: takes what it returned.
        """
        coroutine: Any = None
        try:
            returned = callback(*arguments)
            if type(returned) is types.CoroutineType:
                coroutine = returned
            elif then is not None:
                then(returned)
        finally:
            if coroutine is None:
                entity.callback_group.ending_execution(entity)
        if coroutine is not None:
            self._finish_later(entity, coroutine, then)

    def _finish_later(
        self, entity: Any, coroutine: Coroutine[Any, Any, Any], then: Callable[[Any], None] | None
    ) -> None:
        async def finish() -> None:
            try:
                returned = await coroutine
                if then is not None:
                    then(returned)
            finally:
                entity.callback_group.ending_execution(entity)

        task = Task(finish, executor=self)
        with self._tasks_lock:
            self._tasks.append((task, None, None))
        self._step(task)

    def _run_timer(self, timer: Any) -> None:
        if self._begin(timer) and self._take(timer, _call_timer, timer.handle):
            self._call(timer, timer.callback)

    def _run_subscription(self, subscription: Any) -> None:
        if not self._begin(subscription):
            return
        take = subscription.handle.take_message
        taken = self._take(subscription, take, subscription.msg_type, subscription.raw)
        if taken is None:
            return
        if subscription._callback_type is Subscription.CallbackType.MessageOnly:  # noqa: SLF001
            self._call(subscription, subscription.callback, taken[0])
        else:
            self._call(subscription, subscription.callback, *taken)

    def _run_guard(self, guard: Any) -> None:
        if self._begin(guard):
            guard._executor_triggered = False  # noqa: SLF001 - as rclpy's _take_guard_condition
            self._call(guard, guard.callback)

    def _run_client(self, client: Any) -> None:
        if not self._begin(client):
            return
        taken = self._take(client, client.handle.take_response, client.srv_type.Response)
        if taken is not None:
            self._call(client, self._answer, client, *taken)

    def _answer(self, client: Any, header: Any, response: Any) -> None:
        if header is None:
            return
        try:
            future = client.get_pending_request(header.request_id.sequence_number)
        except KeyError:
            return  # cancelled
        future._set_executor(self)  # noqa: SLF001 - as rclpy's _take_client
        future.set_result(response)

    def _run_service(self, service: Any) -> None:
        if not self._begin(service):
            return
        take = service.handle.service_take_request
        taken = self._take(service, take, service.srv_type.Request)
        if taken is None:
            return
        request, header = taken
        if header is None:
            service.callback_group.ending_execution(service)
            return
        self._call(
            service,
            service.callback,
            request,
            service.srv_type.Response(),
            then=lambda response: service.send_response(response, header),
        )

    def _run_waitable(self, waitable: Any) -> None:
        if not self._begin(waitable):
            return
        try:
            data = waitable.take_data()
        except BaseException as error:
            waitable.callback_group.ending_execution(waitable)
            if isinstance(error, InvalidHandle):
                return  # a callback before it has destroyed it
            raise
        for future in waitable._futures:  # noqa: SLF001 - as rclpy's _take_waitable
            future._set_executor(self)  # noqa: SLF001
        self._call(waitable, waitable.execute, data)


def described(callback: Callable[[], None]) -> str:
    """Return what a callback from `next_callback` is of, in words; empty for the rest of a task."""
    if not isinstance(callback, functools.partial):
        return ""
    entity, kind = callback.args[0], callback.func.__name__
    try:
        if kind == "_run_subscription":
            return f"of the subscription of {entity.topic_name}"
        if kind == "_run_service":
            return f"of the service {entity.service_name}"
        if kind == "_run_timer":
            return f"of a timer of {entity.timer_period_ns / 1e9:g} s"
    except (InvalidHandle, AttributeError):
        pass  # a callback before it has destroyed it
    return ""


def _call_timer(handle: Any) -> bool | None:
    """Begin a timer's next period; None if it was cancelled since."""
    if not handle.is_timer_ready():
        return None
    handle.call_timer()
    return True
