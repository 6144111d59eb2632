"""Where a shift is cut out of a log: by what a transmission reports, or by the commands of the valves.

A layer of its own, so that replay, the J1939 summary and the inference cut the same shifts.
"""
