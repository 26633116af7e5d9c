"""`serial:socket://`: pyserial's socket is read as a whole, not byte by byte."""

import select
import socket

from adis_gonio.device.bus import serial as ports


def test_one_call_takes_all_that_has_arrived():
    sent = bytes(range(1, 251)) * 16
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = ports.open_port(
            f"socket://127.0.0.1:{server.getsockname()[1]}", 500_000, "serial:socket://…"
        )
        board, _ = server.accept()
        with board:
            board.sendall(sent)
            assert select.select([port._port.fileno()], [], [], 60)[0]
            got, calls = b"", 0
            while len(got) < len(sent):
                got += port.receive(1.0)
                calls += 1
        port.close()
    assert got == sent
    assert calls < 40, "a few pieces, as the network makes them"
