"""`python -m sil.cli` is the command `opc4`."""

from sil.cli import command

command()
