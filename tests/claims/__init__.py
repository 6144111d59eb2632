"""The thesis's claims, each measured; `python -m tests.claims` writes docs/claims.md."""
