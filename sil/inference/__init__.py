"""Data against simulation: one problem, one fit, one evidence, one search, one verdict."""
