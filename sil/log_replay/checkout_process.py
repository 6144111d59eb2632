"""Run the control unit of a checkout for `sil.log_replay.checkout`: python FILE CHECKOUT DESCRIPTOR.

Of that checkout it needs can_dbc and controller only: `ControllerNode(config).advance`.
"""

import contextlib
import sys
from multiprocessing.connection import Connection


def main(checkout: str, descriptor: int) -> None:
    """Receive the settings, then the arguments of each `advance`; answer each."""
    sys.path.insert(0, checkout)
    pipe = Connection(descriptor)
    settings = pipe.recv()
    try:
        from can_dbc.frame import Frame
        from controller.config import load_config
        from controller.node import ControllerNode

        node = ControllerNode(load_config(settings, "settings"))
    except Exception as error:  # the code may be anything; the other side reports the last line
        sys.exit(f"{type(error).__name__}: {error}")
    pipe.send(None)
    with contextlib.suppress(EOFError):
        while True:
            until_ns, frames = pipe.recv()
            deliveries = [(time_ns, Frame(*frame)) for time_ns, frame in frames]
            released, next_ns = node.advance(until_ns, deliveries)
            pipe.send(([(time_ns, tuple(frame)) for time_ns, frame in released], next_ns))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
