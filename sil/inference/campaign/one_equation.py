"""One equation at a time: what measurements fed into part of the model leave of the rest.

Measured position into the chambers' mass balances, measured pressures into the stay's force balance
(thesis 3.4.2): a residual of the first belongs to flow, volume, exponents or valve timing, one of the
second to friction, masses, loads or geometry.
Checked by: tests/unit/sil/inference/campaign/test_one_equation.py
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from plant.errors import IntegrationError
from plant.systems.imposed import motion_along, pressures_along
from sil.campaign.campaign import Floats
from sil.inference.campaign.model import CampaignModel
from sil.inference.campaign.observations import Channel, StrokeObservation
from sil.inference.fit import FitResult


@dataclass(frozen=True)
class Alone:
    """Residuals (measured - predicted) of a stroke, equation by equation.

    position_m: of the force balance under the measured pressures; pressures_pa: of each chamber's
    mass balance under the measured position.  None or missing where a channel is.
    """

    time_s: Floats
    position_m: Floats | None
    pressures_pa: dict[str, Floats]

    def rms(self) -> dict[str, float]:
        """Return rms by equation [m], [Pa]."""
        values_by_equation = {}
        if self.position_m is not None:
            values_by_equation["force balance of the stay"] = float(
                np.sqrt(np.mean(self.position_m**2))
            )
        for name, values in self.pressures_pa.items():
            values_by_equation[f"mass balance of chamber {name}"] = float(
                np.sqrt(np.mean(values**2))
            )
        return values_by_equation


def alone(model: CampaignModel, fit: FitResult, k: int) -> Alone:
    """Stroke k, equation by equation, under a fit's parameters."""
    from scipy.ndimage import gaussian_filter1d

    stroke = model.strokes[k]
    setup = model.setup(k, model.amounts(fit.shared, fit.stroke[k]), fit.candidates, fit.values)
    rows = max((c.rows for c in stroke.channels), key=len, default=np.zeros(0, dtype=np.int64))
    time_s = stroke.time_s[rows]
    whole = {
        c.name: _cleared(model, fit, stroke, c)
        for c in stroke.channels
        if len(c.rows) == len(time_s)
    }
    columns = {name: f"pressure_{name}_pa" for name in stroke.conditions.chambers}
    position = whole.get("position_m")
    if position is None:
        return Alone(time_s, None, {})
    force = None
    if all(column in whole for column in columns.values()):
        measured = np.column_stack([whole[column] for column in columns.values()])
        with suppress(IntegrationError):
            force = position - motion_along(setup, time_s, measured)
    try:
        predicted = pressures_along(setup, time_s, gaussian_filter1d(position, 4.0))
    except IntegrationError:
        return Alone(time_s, force, {})
    pressures = {
        name: whole[column] - predicted[:, j]
        for j, (name, column) in enumerate(columns.items())
        if column in whole
    }
    return Alone(time_s, force, pressures)


def _cleared(
    model: CampaignModel, fit: FitResult, stroke: StrokeObservation, channel: Channel
) -> Floats:
    """Return a measured channel with its fitted offset taken off."""
    index = len(model.unit) + model.offsets.index(stroke.offset_of(channel))
    size = model.spread.offset[channel.kind]
    return np.asarray(channel.measured - fit.shared[index] * size)
