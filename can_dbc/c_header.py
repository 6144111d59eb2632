"""The contract for programs in C: identifiers and end-to-end data ids of every message.

python -m can_dbc.c_header > contract.h
Checked by: tests/unit/can_dbc/test_c_header.py, tests/vcan/test_foreign_controller.py
"""

from __future__ import annotations

import re

from can_dbc.codec import SIGNALS, spec_of


def header() -> str:
    """The header's text: of each message its identifier, and its data ids where it has any."""
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
