"""A firmware's steps up to one of them as a C program, for any debugger.

Checked by: tests/unit/sil/firmware/test_c_firmware.py
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from sil.firmware.contract import Step

_TEXT = """\
/* {name} up to tick {tick}, at {at_s:.6f} s simulated. Beside it: opc4.h. For a debugger:
 *
 *     cc -g -ffp-contract=off -fno-math-errno -I . -o {stem} {stem}.c && gdb -ex 'break at_tick' -ex run ./{stem}
 */
#include "{source}"
#include <stdio.h>

static const unsigned char settings_of_run[] = {{
{settings}
}};
static const struct opc4_frame arrived[] = {{
{frames}
    {{ 0, {{ 0 }}, 0, 0 }} }};
static const struct {{ int64_t now_ns; unsigned first, count; }} steps[] = {{
{steps}
}};

void at_tick(void);
void at_tick(void) {{}}

int main(void)
{{
    memcpy(&fw_in.settings, settings_of_run, sizeof settings_of_run);
    fw_init();
    for (unsigned k = 0; k <= {tick}; k++) {{
        fw_in.now_ns = steps[k].now_ns;
        fw_in.count = steps[k].count;
        memcpy(fw_in.frames, &arrived[steps[k].first], steps[k].count * sizeof arrived[0]);
        memset(&fw_out, 0, sizeof fw_out);
        if (k == {tick})
            at_tick();
        fw_step();
    }}
    for (unsigned k = 0; k < fw_out.count; k++) {{
        printf("%08X#", (unsigned)fw_out.frames[k].id);
        for (unsigned byte = 0; byte < fw_out.frames[k].length; byte++)
            printf("%02x", fw_out.frames[k].data[byte]);
        printf("\\n");
    }}
    return 0;
}}
"""


def program(source: Path, settings: bytes, steps: Sequence[Step], stem: str) -> str:
    """Return the program that takes the steps, the last one after a call of `at_tick`."""
    frames = [arrival for step in steps for arrival in step.frames]
    firsts = [0]
    for step in steps:
        firsts.append(firsts[-1] + len(step.frames))
    return _TEXT.format(
        name=source.name,
        stem=stem,
        source=source,
        tick=len(steps) - 1,
        at_s=steps[-1].now_ns / 1e9,
        settings=_lines(f"{byte}," for byte in settings),
        frames="\n".join(
            f"    {{ {at_ns}, {{ {', '.join(map(str, data)) or 0} }}, 0x{can_id:08X}u, {len(data)} }},"
            for at_ns, (can_id, data) in frames
        ),
        steps="\n".join(
            f"    {{ {step.now_ns}, {first}, {len(step.frames)} }},"
            for step, first in zip(steps, firsts, strict=False)
        ),
    )


def _lines(words: Iterable[str]) -> str:
    listed = list(words)
    return "\n".join("    " + " ".join(listed[k : k + 24]) for k in range(0, len(listed), 24))
