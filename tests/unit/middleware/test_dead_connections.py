"""TCP connections that nobody answers are given up, and no others."""

from __future__ import annotations

import contextlib
import socket
import time

from lifecycle.middleware.dead_connections import give_up_dead_connections

_ESTABLISHED, _SYN_SENT = 1, 2  # tcp_states.h


def _state(each: socket.socket) -> int:
    return each.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0]


def test_a_connection_that_nobody_takes_is_given_up_and_one_that_lives_is_not() -> None:
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.socket())
        server.bind(("127.0.0.1", 0))
        server.listen(0)
        dialled = []
        deadline = time.monotonic() + 10
        # Once the queue of those who wait to be accepted is full, the kernel answers nobody more.
        while not dialled or _state(dialled[-1]) != _SYN_SENT:
            assert time.monotonic() < deadline
            each = stack.enter_context(socket.socket())
            each.setblocking(False)
            each.connect_ex(server.getsockname())
            dialled.append(each)
        alive = [each for each in dialled if _state(each) == _ESTABLISHED]
        assert alive
        assert give_up_dead_connections() >= 1
        assert _state(dialled[-1]) != _SYN_SENT
        assert [_state(each) for each in alive] == [_ESTABLISHED] * len(alive)
    assert give_up_dead_connections() == 0
