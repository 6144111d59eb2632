"""One equation at a time: what measurements fed into part of the model leave of the rest.

Measured position into the chambers' mass balances, measured pressures into the stay's force balance
(thesis 3.4.2): a residual of the first belongs to flow, volume, exponents or valve timing, one of the
second to friction, masses, loads or geometry.
Checked by: tests/unit/sil/diagnosis/test_one_equation.py
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from plant.errors import IntegrationError
from plant.systems.imposed import motion_along, pressures_along
from sil.fitting.fit import FitResult
from sil.fitting.model import CampaignModel
from sil.fitting.observations import Channel

Floats = NDArray[np.float64]

SMOOTH_SAMPLES = 4.0
"""Width of the smoothing of the measured position, which is a volume of a chamber."""


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
        found = {}
        if self.position_m is not None:
            found["force balance of the stay"] = float(np.sqrt(np.mean(self.position_m**2)))
        for name, values in self.pressures_pa.items():
            found[f"mass balance of chamber {name}"] = float(np.sqrt(np.mean(values**2)))
        return found


def alone(model: CampaignModel, fit: FitResult, k: int) -> Alone:
    """Stroke k, equation by equation, under a fit's parameters."""
    from scipy.ndimage import gaussian_filter1d

    stroke = model.strokes[k]
    setup = model.setup(k, model.amounts(fit.shared, fit.stroke[k]), fit.candidates, fit.values)
    time_s = stroke.time_s
    whole = {c.name: c for c in stroke.channels if len(c.measured) == len(time_s)}
    names = {name: f"pressure_{name}_pa" for name in stroke.conditions.chambers}
    position = None
    pressures: dict[str, Floats] = {}
    if all(column in whole for column in names.values()):
        measured = np.column_stack([_cleared(model, fit, whole[c]) for c in names.values()])
        try:
            if "position_m" in whole:
                moved = motion_along(setup, time_s, measured)
                position = _cleared(model, fit, whole["position_m"]) - moved
        except IntegrationError:
            position = None
    if "position_m" in whole:
        smooth = gaussian_filter1d(_cleared(model, fit, whole["position_m"]), SMOOTH_SAMPLES)
        try:
            predicted = pressures_along(setup, time_s, smooth)
        except IntegrationError:
            return Alone(time_s, position, {})
        for j, (name, column) in enumerate(names.items()):
            if column in whole:
                pressures[name] = _cleared(model, fit, whole[column]) - predicted[:, j]
    return Alone(time_s, position, pressures)


def _cleared(model: CampaignModel, fit: FitResult, channel: Channel) -> Floats:
    """Return a measured channel with its fitted offset taken off."""
    index = len(model.unit) + model.offsets.index(channel.name)
    size = (
        model.spread.position_offset_m
        if channel.kind == "position"
        else model.spread.gauge_offset_pa
    )
    return np.asarray(channel.measured - fit.shared[index] * size)
