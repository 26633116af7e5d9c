"""The rig's serial line: the bytes come back through the kernel's tty, and the board sees its signals."""

import serial

from kernel.bench import Bench, node


def test_bytes_come_back_through_the_tty_and_the_board_sees_the_line(bench: Bench) -> None:
    port = bench.plug("echo-serial", "RIG-1")
    with serial.Serial(str(node("RIG-1", "tty")), 500_000, timeout=2) as line:
        for size in (1, 64, 700):
            data = bytes(k % 251 for k in range(size))
            line.write(data)
            assert line.read(size) == data
        assert bench.state(port)["baud_rate"] == 500_000
        assert bench.state(port)["line_state"] == 3
        line.dtr = False
        assert bench.state(port)["line_state"] == 2
