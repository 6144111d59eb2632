"""The simulator from Python: `from sil import run, simulate, whatif, diagnose, replay`.

Each function does what the command of its name does and returns the result as typed values; it
writes nothing unless it is given a folder. Bad input raises InputError; a run that cannot finish
raises RunError.
Checked by: tests/unit/sil/test_api.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sil.files.overrides import NO_SETTINGS, Settings
from sil.files.quantity import counted, html_table

if TYPE_CHECKING:
    import numpy as np
    import pandas
    from numpy.typing import NDArray

    from sil.campaign.simulate import SimulatedStroke
    from sil.inference.campaign.diagnosis import Diagnosis
    from sil.log_replay.replay import ReplayResult
    from sil.simulation.in_memory import Run

Where = str | Path


@dataclass(frozen=True)
class Sweep:
    """A finished study: numbers and texts of results.csv by column, and the content of summary.json.

    numbers [rows]: columns that hold numbers, NaN for none. texts [rows]: the other columns.
    """

    numbers: dict[str, NDArray[np.float64]]
    texts: dict[str, list[str]]
    summary: dict[str, Any]

    @property
    def passed(self) -> bool:
        """Return whether every row ran and met its expectation."""
        return all(outcome == "passed" for outcome in self.texts["outcome"])

    def __repr__(self) -> str:
        rows = max((len(column) for column in self.numbers.values()), default=0)
        return f"Sweep({counted(rows, 'row')}: {', '.join([*self.texts, *self.numbers])})"

    def _repr_html_(self) -> str:
        columns = [*self.texts.values(), *([f"{v:.6g}" for v in c] for c in self.numbers.values())]
        rows = list(zip(*columns, strict=True))[:20]
        return html_table(repr(self), [*self.texts, *self.numbers], rows)

    def to_pandas(self) -> pandas.DataFrame:
        """Return the table of results. Needs pandas."""
        import pandas

        return pandas.DataFrame({**self.texts, **self.numbers})


def run(
    scenario: Where | Mapping[str, Any],
    settings: Settings = NO_SETTINGS,
    *,
    model: Where | None = None,
    seed: int | None = None,
) -> Run:
    """Run a scenario in memory, as `opc4 run --strict` does; return its checks, metrics, signals and frames.

    - `scenario`: a scenario file, a shipped name, or a table of a scenario's values
    - `settings`: values of the scenario or model to change, by path
    - `model`: parameter set or model file of the plant
    - `seed`: seed of all random numbers

    Raises InputError if the scenario, a setting or the model is not valid, RunError if a participant fails.
    """
    from sil.simulation import load_scenario
    from sil.simulation.in_memory import run_in_memory

    chosen = None if model is None else str(model)
    options: dict[str, Any] = {"model": chosen, "settings": settings, "seed": seed}
    if isinstance(scenario, Mapping):
        loaded = load_scenario.from_table(scenario, "scenario", **options)
    else:
        loaded = load_scenario.load(str(scenario), **options)
    return run_in_memory(loaded)


def simulate(
    campaign: Where, settings: Settings = NO_SETTINGS, *, model: Where = "nominal"
) -> list[SimulatedStroke]:
    """Simulate each stroke of a campaign, as `opc4 simulate` does; return them in the campaign's order.

    - `campaign`: campaign folder
    - `settings`: model values to change, by path
    - `model`: parameter set or model file of the plant

    Raises InputError if the campaign, the model or a setting is not valid.
    """
    from plant.effects import overridden
    from plant.parameters import load
    from sil.campaign.campaign import load_campaign
    from sil.campaign.simulate import simulate_campaign
    from sil.files.overrides import model_settings

    parameters = load(str(model))
    parameters = overridden(parameters, model_settings(settings, parameters))
    return list(simulate_campaign(load_campaign(campaign), parameters))


def whatif(
    study: Where, *, out: Where, model: Where | None = None, workers: int = 1, resume: bool = False
) -> Sweep:
    """Run the rows of a study, as `opc4 whatif` does; return the table and its summary.

    - `study`: a study file or a shipped name
    - `out`: folder for results.csv, made if missing
    - `model`: parameter set or model file of the plant; None for that of the study
    - `workers`: number of processes
    - `resume`: continue the rows that the folder holds

    Raises InputError if the study or the folder is not valid, RunError if a worker dies.
    """
    from sil.files.output_folder import locked_folder
    from sil.studies.executor import run_study
    from sil.studies.load_study import load_study
    from sil.studies.table import read_table, summary

    loaded = load_study(str(study), model=None if model is None else str(model))
    with locked_folder(Path(out)) as folder:
        run_study(loaded, folder, workers=workers, resume=resume)
        table = read_table(loaded, folder)
    return Sweep(table.numbers, table.texts, summary(loaded, table))


def diagnose(
    campaign: Where | Sequence[Where],
    *,
    model: Where = "nominal",
    workers: int = 2,
    plan: bool = False,
) -> Diagnosis:
    """Diagnose a campaign, as `opc4 diagnose` does; return the verdict, its causes and the extended model.

    - `campaign`: campaign folder, or folders of one unit
    - `model`: parameter set or model file of the plant
    - `workers`: number of processes
    - `plan`: say what to measure next (`next_experiment`) even if nothing is left to separate, as `--next`

    Raises InputError if the campaign or the model is not valid.
    """
    from plant.parameters import load
    from sil.campaign.campaign import joined, load_campaign
    from sil.inference.campaign.diagnosis import diagnose as diagnosed

    folders = [campaign] if isinstance(campaign, str | Path) else campaign
    together = joined([load_campaign(folder) for folder in folders])
    return diagnosed(together, load(str(model)), workers=workers, plan=plan)


def replay(
    log: Where, settings: Settings = NO_SETTINGS, *, firmware: Where | None = None
) -> ReplayResult:
    """Feed the recorded inputs of a log to the firmware alone, as `opc4 replay` does; return the differences.

    - `log`: a CAN log of any format
    - `settings`: firmware values to change, by path
    - `firmware`: settings (TOML, or a run's result.json), or FILE.py:CLASS of a user's own firmware

    Raises InputError if the log cannot be used or requests no shift, RunError if the firmware fails.
    """
    from sil.log_replay.replay import ReplayRequest
    from sil.log_replay.replay import replay as replayed

    program = None if firmware is None else str(firmware)
    return replayed(ReplayRequest(log=str(log), settings=settings, firmware=program))
