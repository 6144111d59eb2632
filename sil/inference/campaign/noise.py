"""Noise of measured channels, estimated from what they do between neighbouring samples.

Checked by: tests/unit/sil/inference/campaign/test_noise.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from math import comb

import numpy as np

from plant.errors import IntegrationError
from sil.campaign.campaign import Floats, Record
from sil.inference.campaign.observations import Noise, StrokeObservation, kind_of


def noise_of(values: Floats, time_s: Floats | None = None) -> float:
    """Return the standard deviation of the noise of values [n] at time_s [n], at least their rounding.

    By sixth differences, which motion hardly changes, and by the quiet parts of the upper half of the
    spectrum. The quietest part alone would be too quiet by chance: all count that are as quiet as the
    second quietest, within what chance allows.
    """
    instants = np.arange(float(len(values))) if time_s is None else time_s
    windows = partial(np.lib.stride_tricks.sliding_window_view, window_shape=7)
    apart = windows(instants) / np.ptp(instants)
    apart = (apart[:, :, None] - apart[:, None, :]) * len(instants) + np.eye(7)
    weights = 1.0 / np.prod(apart, axis=2)
    weights /= np.linalg.norm(weights, axis=1)[:, None]
    differences = np.sum(weights * windows(values), axis=1)
    robust = float(np.median(np.abs(differences))) / 0.6745
    window = np.hanning(len(values))
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2 / np.sum(window**2)
    bands = np.array_split(power[len(power) // 2 : -1], 8)
    levels = np.array([np.median(band) for band in bands])
    # ratio that the medians of two parts of a white spectrum have by chance at most
    chance = np.exp(4.0 / len(bands[-1]) ** 0.5)
    most = chance * np.sort(levels)[1]
    quiet = [band for band, level in zip(bands, levels, strict=True) if level <= most]
    spectral = float(np.median(np.concatenate(quiet))) / np.log(2.0)
    return float(max(min(robust, spectral**0.5), rounding_of(values) / 12.0**0.5))


def rounding_of(values: Floats) -> float:
    """Return the step to which values [n] are rounded; 0 if that is not visible."""
    distinct = np.unique(values)
    if len(distinct) > 0.5 * len(values) or len(distinct) < 3:
        return 0.0
    steps = np.diff(distinct)
    return float(np.median(steps[steps > 1e-9 * np.ptp(values)]))


def estimated_noise(
    strokes: Sequence[StrokeObservation], records: Sequence[Record], nominal: Mapping[str, Noise]
) -> dict[str, Noise]:
    """Return the noise of each channel that differs from the nominal noise of its kind.

    By third differences of measured - predicted where the prediction is smooth; where few samples leave
    that uncertain, that of all channels of its kind counts.
    """
    differences: dict[str, list[Floats]] = {}
    steps: dict[str, float] = {}
    for stroke, record in zip(strokes, records, strict=True):
        try:
            states = stroke.predictor.states(stroke.setup)
        except IntegrationError:
            continue
        for channel in stroke.channels:
            predicted = stroke.predicted(channel, states, stroke.setup)
            smooth = np.abs(np.diff(predicted, 3)) < 0.5 * nominal[channel.kind].sd
            moved = np.diff(channel.measured - predicted, 3)[smooth]
            differences.setdefault(channel.name, []).append(np.abs(moved))
            column = record[channel.name]
            step = float(np.diff(np.unique(column)).min()) if rounding_of(column) > 0.0 else 0.0
            steps[channel.name] = min(step, steps.get(channel.name, step))
    pooled = {name: np.concatenate(parts) for name, parts in differences.items()}
    noise = {}
    for name in pooled:
        kind = kind_of(name)
        alike = [values for other, values in pooled.items() if kind_of(other) == kind]
        channel_noise = _noise(pooled[name], steps[name])
        # an estimate this near to what is known already, standard errors aside, does not replace it
        alike_within = {"position": 0.45, "pressure": 0.03, "oil": 0.05}[kind]
        usual, mean = nominal[kind], _noise(np.concatenate(alike), steps[name])
        best = usual if _agree(mean, usual, alike_within) else mean
        best = best if _agree(channel_noise, best, alike_within) else channel_noise
        if best is not usual:
            noise[name] = best
    return noise


def _agree(one: Noise, other: Noise, share: float) -> bool:
    return abs(one.sd / other.sd - 1.0) <= share + 2.0 * one.uncertainty


def _noise(differences: Floats, step: float) -> Noise:
    if len(differences) < 12:
        return Noise(1.0, step, np.inf)
    # the others may be motion; 0.5565 is the rms of these for a standard normal distribution
    lowest = np.sort(differences)[: int(0.7 * len(differences))]
    sd = float(np.sqrt(np.mean(lowest**2))) / 0.5565 / comb(6, 3) ** 0.5
    return Noise(max(sd, step / 12.0**0.5), step, 2.5 / len(differences) ** 0.5)
