"""What every run must keep, and whoever breaks it."""

from sil.rules.rule import Circumstances, Rule, Violation, violations

__all__ = ["Circumstances", "Rule", "Violation", "violations"]
