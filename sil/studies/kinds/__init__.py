"""Kinds of studies: each module makes the rows of its kind and draws them."""
