"""Common formats that are not read are refused with what converts them."""

from __future__ import annotations

from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.logs import open_log

VSPY = "Vehicle Spy 3 Export\nLine,Abs Time(Sec),Rel Time (Sec),Status,Er,Tx,Description\n"
FOREIGN = {
    "busmaster.log": "***BUSMASTER Ver 3.2.2***\n***PROTOCOL CAN***\n10:1:2:3 Rx 1 0x123 s 1 00\n",
    "vspy.csv": VSPY,
    "car.crtd": "1320745424.000 CXX OVMS CRTD\n1320745424.002 R11 402 FA 01 C3 A0 96 00 07 01\n",
    "bus.txt": "1320745424.002 1R29 18F00503 FA 01 C3 A0 96 00 07 01\n",
    "old.txt": "# Logger type: CL2000\nTimestamp;Type;ID;Data\n",
    "trace.txt": "ASCII Trace IXXAT V1.3\n",
    "log.db": "SQLite format 3\0",
    "canoe.csv": "Time[s];Channel;ID;Name;Dir;DLC;Data\n0.1;CAN 1;123;X;Rx;1;00\n",
    "kvaser.csv": "Time,Channel,ID,Flags,DLC,Data0\n",
}


@pytest.mark.parametrize("name", FOREIGN)
def test_what_converts_a_foreign_log_is_said(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(FOREIGN[name])
    with pytest.raises(InputError, match="which is not read; expected one of ") as no:
        open_log(tmp_path / name)
    assert "\n" not in str(no.value)
    assert ("python-can" in str(no.value)) is (name == "log.db")
