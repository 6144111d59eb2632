"""Tutorial, theory and reference."""
