"""Write docs/claims.md."""

from pathlib import Path

from tests.claims.claim import all_claims, check, markdown

(Path(__file__).parents[2] / "docs" / "claims.md").write_text(
    markdown(map(check, all_claims())), encoding="utf-8"
)
