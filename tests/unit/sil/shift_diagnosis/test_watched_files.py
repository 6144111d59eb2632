"""Which files `opc4 watch` takes: of which truck, in which order, and files of observations."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from can_dbc.errors import InputError
from sil.logs import LogFrame, open_writer
from sil.shift_diagnosis.watched_files import in_time, is_observations, log_files, observed


def files(target: Path) -> list[tuple[str, str]]:
    return [(truck, path.name) for truck, path in log_files([str(target)])]


def test_trucks_and_logs_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("2/10.log", "2/9.log", "10/a.asc", "2/day 3/1.MF4", "2/notes.pdf", "2/._9.log"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    wanted = [("2", "9.log"), ("2", "10.log"), ("2", "1.MF4"), ("10", "a.asc")]
    assert sorted(files(tmp_path)) == sorted(wanted)
    assert [name for truck, name in files(tmp_path) if truck == "2"][:2] == ["9.log", "10.log"]
    assert files(tmp_path)[-1] == ("10", "a.asc")


def test_links_are_followed_but_not_in_a_circle(tmp_path: Path) -> None:
    real, fleet = tmp_path / "disk", tmp_path / "fleet"
    real.mkdir()
    fleet.mkdir()
    (real / "1.log").touch()
    (real / "again").symlink_to(real)
    (fleet / "truck 7").symlink_to(real)
    assert files(fleet) == [("truck 7", "1.log")]
    assert files(fleet / "truck 7" / "1.log") == [("truck 7", "1.log")]


def test_a_folder_that_cannot_be_read_is_no_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "1.log").touch()
    monkeypatch.setattr(os, "scandir", lambda path: (_ for _ in ()).throw(PermissionError(path)))
    with pytest.raises(PermissionError):
        files(tmp_path)


def test_logs_are_sorted_by_time_only_where_all_have_the_time_of_day(tmp_path: Path) -> None:
    begins = {"a": 1_700_000_100, "b": 1_700_000_000, "c": 0}
    paths = {name: tmp_path / f"{name}.log" for name in begins}
    for name, path in paths.items():
        with open_writer(path) as writer:
            writer.write(LogFrame(begins[name] * 10**9, 0x123, b"\x01"))
    a, b, c = paths.values()
    broken = tmp_path / "broken.mf4"
    broken.write_bytes(b"none")
    assert in_time([broken, a, b]) == [b, a, broken]
    assert in_time([c, a, b]) == [c, a, b]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("time_s,a\n1,2\n", "line 1: time_s,a; expected time_s, then NAME and NAME_sd"),
        ("time_s,a,a_sd\n", "no line after the first"),
        ("time_s,a,a_sd\n1,2,3\n1,2,x\n", "line 3: '1,2,x'; expected 3 numbers"),
        ("time_s,a,a_sd\n1,2,3\n\n", "line 3: ''; expected 3 numbers"),
        ("time_s,a,a_sd\n1,2,3\n1,nan,3\n", "line 3: '1,nan,3'; expected numbers up to 1e"),
        ("time_s,a,a_sd\n1,2,1e-40\n", "line 2: '1,2,1e-40'; .* above 0"),
        ("time_s,a,a_sd\n1700000000000,2,3\n", "line 2: .*; expected a time in s"),
        ("time_s,a,a_sd,a,a_sd\n1,2,3,2,3\n", "line 1: .* each name once"),
        ("time_s,,_sd\n1,2,3\n", "line 1: .* each name once"),
        ("time_s,a,a_sd\n1,2,0\n", "line 2: '1,2,0'; .* above 0"),
        ("time_s,a,a_sd\n1,2,3,4\n", "line 2: '1,2,3,4'; expected 3 numbers"),
        ("time_s,a,a_sd\n1,2,\udcff\n", "line 2: .*expected 3 numbers"),
    ],
)
def test_bad_observations_are_refused(tmp_path: Path, text: str, wrong: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    assert is_observations(path)
    with pytest.raises(InputError, match=wrong):
        observed(path, None)


@pytest.mark.parametrize(
    "text",
    [
        b"\xef\xbb\xbftime_s,a,a_sd\r\n10,0.5,0.5\r\n20,0.7,0.5\r\n",
        b"time_s; a ;a_sd\n10;0,5;0,5\n20;0,7;0.5\n",
    ],
)
def test_observations_as_a_spreadsheet_writes_them(text: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(text)
    assert is_observations(path)
    track, changes, taken = observed(path, None)
    assert (track.names, changes) == (("a",), [])
    assert (taken.shifts, taken.begin_s, taken.end_s) == (2, 10.0, 20.0)


def test_a_can_log_as_csv_is_no_file_of_observations(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    with open_writer(path) as writer:
        writer.write(LogFrame(10**9, 0x123, b"\x01"))
    assert path.read_text().startswith("time_s,")
    assert not is_observations(path)
