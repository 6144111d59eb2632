"""The software-in-the-loop side: coupling, scenarios, commands, pictures and reports.

`from sil import run, simulate, whatif, diagnose, replay`: the commands from Python, see `sil.api`.
Checked by: tests/unit/sil/test_api.py
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sil.api import diagnose, replay, run, simulate, whatif

__all__ = ["diagnose", "replay", "run", "simulate", "whatif"]


def __getattr__(name: str) -> Any:
    """Return a function of `sil.api`, imported on first use. Raises AttributeError for other names."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sil import api

    return getattr(api, name)
