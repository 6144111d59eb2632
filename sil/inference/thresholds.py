"""Every limit of a verdict, in one record."""

from __future__ import annotations

from dataclasses import dataclass

from plant.effects.term import term

UNNAMED = term.id
"""The cause of a non-parametric term, and the verdict that one acts."""


@dataclass(frozen=True)
class Thresholds:
    """Limits of a verdict.

    Calibrated by `python -m tests.bench hidden_effects` (campaigns) and `python -m tests.bench bodies`
    (force rigs); their counts are in docs/explanation/accuracy.md.
    """

    max_residual_ratio: float = 1.25
    """Residual over expected noise that noise explains: the noise is an estimate itself."""
    max_detail_per_number: float = 0.02
    """Excess of chi squared per number that is a detail, if no channel is far off by itself."""
    max_channel_excess: float = 1.0
    """Excess per number of one channel from which it is far off, however few numbers it has."""
    min_strain_probability: float = 1e-6
    """How rarely healthy scatter or tolerances may come out so wide."""
    min_gain: float = 15.0
    """Log evidence that a cause gains at least, ..."""
    min_gain_per_block: float = 1.5
    """... and at least per block: an effect that changes next to nothing is not claimed."""
    min_deviations: float = 2.0
    """Standard deviations by which a cause's main parameter excludes its neutral value."""
    max_unexplained_share: float = 0.5
    """Share of the healthy misfit that an explanation may leave, if noise does not explain the rest."""
    min_share_of_rest: float = 0.3
    """Share of what a hypothesis still leaves that a further cause gains at least."""
    form_error: float = 0.005
    """Share of what a cause does to which its form is trusted (less, where an effect says so): a further cause gains more."""
    slight_size: float = 0.1
    """Typical sizes below which a further cause is slight, ..."""
    min_slight_share: float = 0.02
    """... and gains at least this share of the healthy misfit: else it corrects the first one's form."""
    slight_cause_probability: float = 0.45
    """Probability that a slight cause acts, if its hypothesis leaves more than noise."""
    min_rival_probability: float = 0.05
    """A cause that may replace the leading one is at least so probable."""
    min_contest_share: float = 0.02
    """An explanation that contests the leader is at least so probable, against the likeliest."""
    min_named_probability: float = 0.7
    """From here on a cause is named."""
    unnamed_prior: float = 0.02
    """Prior odds of something that the catalogue does not hold against what explains the data best."""
    form_share: float = 0.01
    """Share of the healthy misfit that a right cause of slightly another form leaves, ..."""
    form_power: float = 2.3
    """... and how fast larger shares become less likely."""
    unnamed_odds_beside_a_term: float = 1.2
    """Odds that a cause beside a term without a form is no more than a stepping stone."""
    robust_share: float = 0.9
    """Probability of a cause beside a residual whose descriptions leave it as it is (force rigs)."""
    min_standard_errors: float = 3.0
    """Least gain of a cause in standard errors over the groups held out, and the like (force rigs)."""
    min_column_share: float = 0.05
    """Share of a cause's force that the body's own parameters cannot make up: else it is not judged."""
    max_removable_share: float = 0.1
    """A residual of which an acceptable cause removes this share is not noise (force rigs)."""
    max_value_ratio: float = 2.0
    """A cause keeps its value within this factor, whatever describes the residual, in each half of the samples."""
    min_described_share: float = 0.2
    """A function describes a residual if it removes this share of its squares."""
    max_share_beside_delay: float = 0.2
    """Share of the excess over noise that a delay of the driving force leaves at most, in each half too."""
    step_tolerance: float = 0.1
    """A delay is within a sampling step, or half a step (a force held from sample to sample), so nearly."""
    effective_observations: float = 10.0
    """Effective observations of the model's error."""
    pair_prior: float = 0.1
    """Prior odds of two causes at once against one."""
    min_noticeable_share: float = 0.5
    """Share of the catalogue that would be noticed at its typical size, for data that can tell."""
    max_truck_strain: float = 5.0
    """Cost of a truck's own quantities up to which they are ordinary."""
    min_healthy_probability: float = 0.5
    """A truck is called healthy from here on, ..."""
    max_healthy_probability: float = 0.01
    """... and faulty below this."""
    healthy_prior: float = 0.5
    """Probability of a healthy truck before its log is read."""
    failing_healthy_odds: float = 1e-3
    """How rarely a shift of a healthy truck fails."""

    def unnamed_odds(self, share: float) -> float:
        """Return the odds of something without a name, by the share of the misfit that is left."""
        return float(self.unnamed_prior * (1.0 + share / self.form_share) ** self.form_power)

    def needed_gain(self, blocks: int) -> float:
        """Return the log evidence that a cause gains at least on so many blocks."""
        return max(self.min_gain, self.min_gain_per_block * blocks)


LIMITS = Thresholds()
