"""The live bench: shifts, what-ifs, the bus and finished runs in a browser, on this machine only."""
