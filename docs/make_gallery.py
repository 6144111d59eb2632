"""Make the pictures of the gallery, each by the one command that the page shows.

`python docs/make_gallery.py [NAME...]` (`make gallery`) writes docs/images/gallery/*.png and docs/gallery.md.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

FOLDER = Path(__file__).resolve().parent
IMAGES = FOLDER / "images" / "gallery"


class Entry(NamedTuple):
    """A picture: its name, the command that makes it, the file it is in, and what it shows."""

    name: str
    command: str
    file: str
    caption: str


ENTRIES = (
    Entry(
        "full_shift",
        "opc4 run full_shift --transport local --out full_shift",
        "full_shift/shift.png",
        "A shift from backward through neutral to forward: true position and the controller's estimate with its lag, coils and "
        "valves, chamber pressures, firmware states, CAN frames.",
    ),
    Entry(
        "oil_damper",
        "opc4 run oil_damper --out oil_damper",
        "oil_damper/shift.png",
        "The same actuator with today's oil damper: a soft stop that costs time.",
    ),
    Entry(
        "truck",
        "opc4 run truck_into_gear_2200n --out truck",
        "truck/shift.png",
        "Into gear in the truck: the synchronizer holds the stay until the shafts run together.",
    ),
    Entry(
        "lost_frames",
        "opc4 run lost_frames --out lost_frames",
        "lost_frames/shift.png",
        "Frames lost on the bus, and how the firmware copes.",
    ),
    Entry(
        "compare",
        "opc4 compare truck lost_frames --out compare",
        "compare/compare.png",
        "Two runs over each other from the request on: another load, and lost frames.",
    ),
    Entry(
        "replay",
        "opc4 replay full_shift/bus.log --set controller.filter=false --out replay",
        "replay/scene_1.png",
        "A recorded log into a firmware without the position filter: recorded and replayed commands.",
    ),
    Entry(
        "sensor_delay",
        "opc4 whatif sensor_delay --workers 2 --out sensor_delay",
        "sensor_delay/choices.png",
        "A study: what the order of the position filter costs the air cushion.",
    ),
    Entry(
        "budget",
        "opc4 whatif budget --out budget",
        "budget/budget.png",
        "The latency budget: every delay between the first motion and the first counter-force.",
    ),
    Entry(
        "piston_radius",
        "opc4 whatif piston_radius --out piston_radius",
        "piston_radius/curves.png",
        "Hardware: the radius of the piston (thesis 5.1).",
    ),
    Entry(
        "diagnosis",
        "opc4 diagnose measured --out diagnosis",
        "diagnosis/strokes.png",
        "A diagnosis (campaign of the tutorial): measured, nominal and extended model.",
    ),
)


def page() -> str:
    """Return the text of the page."""
    lines = [
        "# Gallery",
        "",
        "Every picture is made by the command below it (`make gallery` makes them all).",
        "",
    ]
    for entry in ENTRIES:
        lines += [f"## {entry.caption.partition(':')[0].partition('.')[0]}", "", entry.caption, ""]
        lines += [f"![{entry.caption}](images/gallery/{entry.name}.png)", ""]
        lines += ["```", entry.command, "```", ""]
    return "\n".join(lines).rstrip() + "\n"


def make_measured(folder: Path) -> None:
    """Make the measured campaign of the tutorial."""
    tutorial = (FOLDER / "tutorial.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(# file: plan/campaign.toml\n.*?)```", tutorial, re.DOTALL)
    (folder / "plan").mkdir()
    (folder / "plan" / "campaign.toml").write_text(text, encoding="utf-8")
    command = ["simulate", "plan", "--set", "valve.D_rise=0.013", "--out", "measured"]
    subprocess.run([sys.executable, "-m", "sil.cli", *command], cwd=folder, check=True)


def main(names: list[str]) -> None:
    """Run the commands in one folder and copy the pictures."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make_measured(folder)
        for entry in ENTRIES:
            if names and entry.name not in names:
                continue
            words = entry.command.split()[1:]
            print(entry.command, flush=True)
            done = subprocess.run(
                [sys.executable, "-m", "sil.cli", *words], cwd=folder, check=False
            )
            if done.returncode not in (0, 1) or not (folder / entry.file).exists():
                made = sorted(p.name for p in (folder / entry.file).parent.glob("*"))
                sys.exit(f"{entry.command}: exit {done.returncode}; no {entry.file} among {made}")
            shutil.copy(folder / entry.file, IMAGES / f"{entry.name}.png")
    (FOLDER / "gallery.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
