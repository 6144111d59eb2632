"""Runs the control unit of the checkout named on the command line, for `sil.log_replay.firmware_under_test`.

Of that checkout it needs can_dbc and controller only: `ControllerNode(config).advance`.
"""

import json
import struct
import sys

HEAD = struct.Struct("<qH")
FRAME = struct.Struct("<qIB")


def main(checkout: str) -> None:
    """Take settings, then ticks with their frames, from standard input; answer each with frames."""
    sys.path.insert(0, checkout)
    take, give = sys.stdin.buffer, sys.stdout.buffer
    table = json.loads(take.readline())
    try:
        from can_dbc.frame import Frame
        from controller.config import load_config
        from controller.node import ControllerNode

        config = load_config(table, "settings")
        node = ControllerNode(config)
    except Exception as error:  # of code that may be anything: the parent tells the user
        sys.exit(f"{type(error).__name__}: {error}")
    give.write(b"ready\n")
    give.flush()
    base_ns = 0
    anew = False
    while len(head := take.read(HEAD.size)) == HEAD.size:
        tick_ns, count = HEAD.unpack(head)
        if tick_ns < 0:
            node, anew = ControllerNode(config), True
            continue
        if anew:
            base_ns, anew = tick_ns, False
        deliveries = []
        for _ in range(count):
            time_ns, can_id, length = FRAME.unpack(take.read(FRAME.size))
            deliveries.append((max(time_ns - base_ns, 0), Frame(can_id, take.read(length))))
        released, _ = node.advance(tick_ns - base_ns, deliveries)
        give.write(HEAD.pack(0, len(released)))
        for _, frame in released:
            give.write(FRAME.pack(0, frame.can_id, len(frame.data)) + frame.data)
        give.flush()


if __name__ == "__main__":
    main(sys.argv[1])
