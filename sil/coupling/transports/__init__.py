"""How frames and turns travel between coordinator and participants.

`channel`: the interface, and calls in one process.  `hub`, `local`: a Unix socket of this machine,
with a python-can interface for everybody else.  `socketcan`: a CAN channel.  `wire` is the protocol
of the latter two, `remote` its coordinator side, `link` its participant side.
"""
