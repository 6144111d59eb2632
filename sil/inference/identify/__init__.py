"""The thesis's own identifications, on the same fit."""
