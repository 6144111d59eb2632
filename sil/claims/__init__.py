"""The thesis's claims against what the simulation gives, one row a claim.

Each claim names what the thesis says, runs what shows it, and says met, partly or not met, with the
reason.  "not met" and "cannot be shown" are answers; a silent omission is not.
"""

from __future__ import annotations

from sil.claims.claim import Claim, Finding, Outcome, all_claims, check

__all__ = ["Claim", "Finding", "Outcome", "all_claims", "check"]
