"""Make a C header of the contract: identifiers and end-to-end data ids of every message.

python -m can_dbc.c_header > contract.h
"""

from __future__ import annotations

import re

from can_dbc.codec import spec_of
from can_dbc.messages import SIGNALS


def header() -> str:
    """Return the header: the identifier of each message, and its data ids if it is protected."""
    lines = ["/* made by python -m can_dbc.c_header from opc4.dbc */", "#include <stdint.h>"]
    for kind in SIGNALS:
        spec = spec_of(kind)
        name = re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).upper()
        lines.append(f"#define {name} 0x{spec.can_id:08X}u")
        if spec.e2e_data_ids:
            ids = ", ".join(map(str, spec.e2e_data_ids))
            lines.append(
                f"static const uint8_t {name}_IDS[{len(spec.e2e_data_ids)}]"
                f" __attribute__((unused)) = {{ {ids} }};"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(header(), end="")
