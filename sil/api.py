"""The simulator from Python: `from sil import run, simulate, whatif, diagnose, replay`.

Each does what the command of its name does, and returns what it found as typed values; it writes
nothing unless it is given a folder. Bad input raises InputError, a run that cannot finish RunError.
Checked by: tests/unit/sil/test_api.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sil.campaign.simulate import SimulatedStroke
    from sil.diagnosis.diagnosis import Diagnosis
    from sil.log_replay.replay import ReplayResult
    from sil.recording.run_record import BusFrame
    from sil.simulation.metrics import Shift
    from sil.simulation.results import Check

Where = str | Path
Value = float | int | bool | str
Settings = Mapping[str, Value] | Sequence[str]
"""{"valve.D_fall": 0.02}, or ["valve.D_fall=0.02"] as the command line takes it."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    signals: the plant's true states and valves [n] by name, over signals["time_s"]. believed: times
    [s] and positions [m] as the controller reported them. frames: all frames in order of arrival.
    """

    passed: bool
    checks: list[Check]
    metrics: dict[str, Any]
    shifts: list[Shift]
    signals: dict[str, NDArray[np.float64]]
    believed: tuple[NDArray[np.float64], NDArray[np.float64]]
    frames: Sequence[BusFrame]
    trace_sha256: str


@dataclass(frozen=True)
class Sweep:
    """A finished study: its columns by name, numbers [rows] (nan for none) and texts [rows].

    texts["outcome"] is passed, failed or not run; texts["reason"] says why a row did not pass.
    """

    numbers: dict[str, NDArray[np.float64]]
    texts: dict[str, list[str]]
    summary: dict[str, Any]

    @property
    def passed(self) -> bool:
        """Return whether every row ran and met its expectation."""
        return all(outcome == "passed" for outcome in self.texts["outcome"])


def run(
    scenario: Where | Mapping[str, Any],
    settings: Settings = (),
    *,
    model: Where | None = None,
    seed: int | None = None,
) -> Run:
    """Run a scenario (file, shipped name, or table of its values) in memory, as `opc4 run` does.

    Raises InputError for what the scenario cannot be, RunError when a participant fails.
    """
    from sil.simulation import scenario as scenarios
    from sil.simulation.expectations import evaluate
    from sil.simulation.in_memory import run_in_memory

    options: dict[str, Any] = {
        "model": None if model is None else str(model),
        "settings": texts(settings),
        "seed": seed,
    }
    if isinstance(scenario, Mapping):
        loaded = scenarios.from_table(scenario, "scenario", **options)
    else:
        loaded = scenarios.load(str(scenario), **options)
    done = run_in_memory(loaded)
    checks = evaluate(loaded.scenario.expect, done.record, done.shifts, done.figures)
    return Run(
        passed=all(check.passed for check in checks),
        checks=checks,
        metrics=done.figures,
        shifts=done.shifts,
        signals=dict(done.record.truth),
        believed=done.record.estimate,
        frames=done.record.frames,
        trace_sha256=done.trace_sha256,
    )


def simulate(
    campaign: Where, settings: Settings = (), *, model: Where = "nominal"
) -> list[SimulatedStroke]:
    """Simulate each stroke of a campaign, as `opc4 simulate` does.

    Raises InputError for a campaign, model or setting that cannot be.
    """
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.campaign.simulate import simulate_campaign
    from sil.files.settings import model_settings

    parameters = load(str(model)).override(model_settings(texts(settings)))
    return list(simulate_campaign(load_campaign(campaign), parameters))


def whatif(study: Where, *, out: Where, workers: int = 1, resume: bool = False) -> Sweep:
    """Run the rows of a study (file or shipped name) into out/results.csv, as `opc4 whatif` does.

    Raises InputError for a study or folder that cannot be.
    """
    from sil.files.output_folder import locked_folder
    from sil.studies.executor import run_study
    from sil.studies.load_study import load_study
    from sil.studies.summary import summary
    from sil.studies.table import read_table

    loaded = load_study(str(study))
    with locked_folder(Path(out)) as folder:
        run_study(loaded, folder, workers=workers, resume=resume)
        table = read_table(loaded, folder)
    return Sweep(table.numbers, table.texts, summary(loaded, table))


def diagnose(campaign: Where, *, model: Where = "nominal", workers: int = 2) -> Diagnosis:
    """Diagnose a campaign, as `opc4 diagnose` does.

    Raises InputError for a campaign or model that cannot be.
    """
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.diagnosis.diagnosis import diagnose as diagnosed

    return diagnosed(load_campaign(campaign), load(str(model)), workers=workers)


def replay(log: Where, settings: Settings = (), *, firmware: Where | None = None) -> ReplayResult:
    """Put the inputs of a recorded log into the firmware alone, as `opc4 replay` does.

    Raises InputError for a log that cannot be used or that engaged nothing.
    """
    from sil.log_replay.replay import ReplayRequest
    from sil.log_replay.replay import replay as replayed

    return replayed(
        ReplayRequest(
            log=str(log),
            settings=texts(settings),
            firmware=None if firmware is None else str(firmware),
        )
    )


def texts(settings: Settings) -> tuple[str, ...]:
    """Settings as PATH=VALUE."""
    from sil.studies.study import toml_value

    if isinstance(settings, Mapping):
        return tuple(f"{path}={toml_value(value)}" for path, value in settings.items())
    return tuple(settings)
