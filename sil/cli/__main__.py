"""`python -m sil.cli` is the command `opc4`."""

import sys

from sil.cli import main

sys.exit(main())
