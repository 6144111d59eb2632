"""A firmware in C or WebAssembly as a control unit on the bus, with what its steps cost.

C is compiled twice: the sanitised build runs ahead of the plain one with the same frames, and both
must answer alike.
"""

from __future__ import annotations

import atexit
import gc
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

from can_dbc.errors import InputError
from can_dbc.frame import Frame
from controller import c_settings
from controller.config import FirmwareConfig
from controller.node import TickingNode
from sil.coupling.transports.channel import ParticipantLost
from sil.files.atomic import write_atomically
from sil.firmware.compiler import compiled
from sil.firmware.contract import MAX_ARRIVED, Step, pack_step, received
from sil.firmware.cost import Cost, write_cost
from sil.firmware.wasm import FirmwareFailure, Instance, Module, engine, read_module

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


class CController(TickingNode):
    """A control unit whose program is FILE.c or FILE.wasm.

    Raises InputError for a file that is no firmware, and ParticipantLost when the firmware fails, both
    with file and line, or the function's name where the module does not say more.
    """

    def __init__(
        self,
        path: Path,
        config: FirmwareConfig,
        name: str = "controller",
        folder: Path | None = None,
    ) -> None:
        """Start the firmware; cost and signals are written into `folder`, if given, at the end."""
        super().__init__(config)
        self.name = name
        self._path = path
        self._folder = folder
        self._signals: list[tuple[int, dict[str, float]]] = []  # time in ns and what was traced
        self._pending: list[tuple[int, Frame]] = []
        self.steps: list[Step] | None = (
            None  # what each was given, if a list is set here to keep it
        )
        self._lost = self._count = self._sum_instructions = self._max_instructions = 0
        self._worst = Step(0, (), 0)
        try:
            settings = c_settings.content(config)
            self._instances = [Instance(module, settings) for module in modules(path)]
        except FirmwareFailure as failure:
            lost = ParticipantLost(name, f"failed: {self._shown(failure)}, in fw_init")
            raise lost.at(0) from None

    def _shown(self, failure: FirmwareFailure) -> str:
        """Return the failure with the path of the source, from the current folder, before it."""
        text, path = str(failure), self._path
        if path.is_relative_to(Path.cwd()):
            path = path.relative_to(Path.cwd())
        file = text.partition(":")[0]
        in_folder = path.parent / file
        return f"{in_folder}{text[len(file) :]}" if in_folder.is_file() else f"{path}: {text}"

    def _receive(self, arrival_ns: int, frame: Frame) -> None:
        if frame.can_id in received():
            self._pending.append((arrival_ns, frame))

    def _step(self, now_ns: int) -> list[Frame]:
        self._lost += max(0, len(self._pending) - MAX_ARRIVED)
        step = Step(now_ns, tuple(self._pending[-MAX_ARRIVED:]), self._lost)
        self._pending.clear()
        if self.steps is not None:
            self.steps.append(step)
        try:
            instructions, frames = self._answer(pack_step(step))
        except FirmwareFailure as failure:
            what = f"failed: {self._shown(failure)}, tick {self._count}"
            raise ParticipantLost(self.name, what) from None
        self._sum_instructions += instructions
        if instructions > self._max_instructions:
            self._max_instructions, self._worst = instructions, step
        if self.config.ns_per_instruction > 0.0:
            self.computation_ns = round(instructions * self.config.ns_per_instruction)
        self._count += 1
        if signals := self._instances[-1].signals():
            self._signals.append((now_ns, signals))
        return frames

    def _answer(self, content: bytes) -> tuple[int, list[Frame]]:
        """Return instructions and frames of the plain build. Raises FirmwareFailure if one build fails."""
        frames = None
        for instance in self._instances:
            instructions = instance.step(content)
            before, frames = frames, instance.frames()
            if before not in (None, frames):
                raise FirmwareFailure(
                    "plain and sanitised build send different frames: a variable without a value, "
                    "or other undefined behaviour that is not caught"
                )
        assert frames is not None
        return instructions, frames

    def cost(self) -> Cost:
        """Return what the steps so far have cost."""
        return Cost(
            steps=self._count,
            mean_instructions=self._sum_instructions / max(1, self._count),
            max_instructions=self._max_instructions,
            max_at_s=self._worst.now_ns / 1e9,
            max_inputs=[f"{can_id:08X}#{data.hex()}" for _, (can_id, data) in self._worst.frames],
            stack_bytes=self._instances[-1].stack_bytes,
            memory_bytes=self._instances[-1].memory_bytes,
        )

    def reproduction(self, stem: str) -> str:
        """Return a C program that takes the steps kept so far."""
        assert self.steps
        return program(self._path, c_settings.content(self.config), self.steps, stem)

    def close(self) -> None:
        """Write cost and signals."""
        folder, self._folder = self._folder, None
        if folder is None:
            return
        write_cost(self.cost(), folder)
        if self._signals:
            names = list(dict.fromkeys(name for _, values in self._signals for name in values))
            rows = [",".join(("time_s", *names))]
            for now_ns, values in self._signals:
                row = (repr(values[name]) if name in values else "" for name in names)
                rows.append(",".join((f"{now_ns / 1e9:.9f}", *row)))
            write_atomically(folder / "firmware.csv", "\n".join(rows) + "\n")


def modules(path: Path) -> tuple[Module, ...]:
    """Return the builds of a firmware, the plain one last. Raises InputError for a file that is none."""
    if not path.exists():
        raise InputError(f"firmware: {path}: no such file; expected FILE.c or FILE.wasm")
    if path.suffix == ".wasm":
        return (_module(read_module(path), str(path)),)
    builds = (compiled(path, sanitised=sanitised) for sanitised in (True, False))
    return tuple(_module(content, str(path)) for content in builds)


_module = lru_cache(maxsize=16)(Module)


@atexit.register
def _forget() -> None:
    """Free the modules while the library that made them is still whole."""
    _module.cache_clear()
    engine.cache_clear()
    gc.collect()
