"""How softly any controller could stop: policies, their loads, their judgement and their search."""
