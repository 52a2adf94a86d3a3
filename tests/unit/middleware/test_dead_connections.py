"""TCP connections that nobody answers are given up, and no others."""

from __future__ import annotations

import contextlib
import socket
import time

from lifecycle.middleware.fastdds.sockets import give_up_dead_connections, is_used

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


def test_a_connection_is_unused_if_nothing_follows_the_answer_to_its_first_request() -> None:
    deadline = time.monotonic() + 30
    with socket.create_server(("127.0.0.1", 0)) as server:
        address, port = server.getsockname()
        assert is_used(address, port) is None
        with socket.create_connection((address, port)) as dialled:
            taken, _ = server.accept()
            with taken:
                dialled.sendall(bytes(68))
                assert is_used(address, port) is None  # the answer may be on its way
                taken.sendall(bytes(68))
                while is_used(address, port) is None:
                    assert time.monotonic() < deadline
                    time.sleep(0.01)
                assert is_used(address, port) is False
                dialled.sendall(bytes(38))
                while not is_used(address, port):
                    assert time.monotonic() < deadline
                    time.sleep(0.01)
