"""A campaign drafted from files of a laboratory, then diagnosed as it is."""

from __future__ import annotations

import importlib
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.campaign.campaign import load_campaign
from sil.campaign.units import unit_of
from sil.cli import main
from sil.inference.campaign.channels import pressures, recognise
from sil.inference.campaign.new_campaign import draft
from sil.inference.force.record import read_motion


@pytest.mark.parametrize(
    ("name", "unit"),
    [("x [mm]", "mm"), ("Kraft (kN)", "kN"), ("p1 / bar", "bar"), ("t_ms", "ms"), ("s [V]", "V")],
)
def test_units_are_found_in_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit


RISING = np.linspace(0.0, 0.01, 5)


@pytest.mark.parametrize(
    ("name", "stored", "chambers", "ours", "scale"),
    [
        ("Weg", "", "", "position_m", 1.0),
        ("Weg", "mm", "", "position_m", 1e-3),
        ("s [V]", "", "", "position_m", None),  # volts are no metres
        ("force", "V", "", "force_n", None),
        ("Druck B [bar]", "", "BNF", "pressure_B_pa", 1e5),
        ("p1", "bar", "12", "pressure_1_pa", 1e5),
        ("pF [bar ü]", "", "BNF", "pressure_F_pa", 1e5),
        ("p_2 [V]", "", "12", "pressure_2_pa", None),
        ("pressure [bar]", "", "12", "", 1.0),
        ("Ventil_F [V]", "", "BNF", "cmd_F", None),
        ("PWM N [%]", "", "BNF", "cmd_N", 0.01),
        ("T [°C]", "", "BNF", "", 1.0),
        ("cmd_B", "", "BNF", "cmd_B", 1.0),
        ("coil_N", "", "BNF", "cmd_N", 1.0),  # no newtons
        ("U_N [V]", "", "BNF", "cmd_N", None),
        ("p_N", "bar", "BNF", "pressure_N_pa", 1e5),
        ("Kraft_N", "", "BNF", "force_n", 1.0),
    ],
)
def test_a_column_is_known_or_asked_about(
    name: str, stored: str, chambers: str, ours: str, scale: float | None
) -> None:
    (channel,) = recognise({name: RISING}, {name: stored}, chambers)
    assert (channel.ours, channel.scale) == (ours, scale)
    assert scale is not None or channel.open


@pytest.mark.parametrize(
    ("units", "level"),
    [
        (("barg", "bar ü"), "gauge"),
        (("kPa abs", "psia"), "absolute"),
        (("barg", "bara"), "?"),
        (("barg", "bar"), "?"),
        (("bar", "bar"), "?"),  # by their level
    ],
)
def test_a_unit_may_say_what_pressures_count_from(units: tuple[str, ...], level: str) -> None:
    columns = {f"p{k}": RISING for k in (1, 2)}
    channels = recognise(columns, dict(zip(columns, units, strict=True)), "12")
    assert pressures(channels, [columns]) == level


def test_time_is_what_does_not_fall() -> None:
    a, b, t = recognise({"a [s]": -RISING, "b [s]": RISING, "t": 1e3 * RISING}, {}, "")
    assert (a.ours, b.ours, b.scale) == ("", "time_s", 1.0) and "a second time_s" in t.open
    assert recognise({"t": 1e5 * RISING}, {}, "")[0].scale is None  # steps of minutes: another unit


@pytest.mark.parametrize(
    ("rig", "written"), [("actuator", "length"), ("fixed", "fixed"), ("cylinder", "fixed")]
)
def test_strokes_with_gauges_and_valves_are_drafted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], rig: str, written: str
) -> None:
    valve, start = ("B", "N") if rig == "actuator" else ("1", "2")
    rows = [
        f"Zeit;Weg;Druck {valve};Druck {start};Ventil {valve};Ventil {start}",
        "ms;mm;bar;bar;V;V",
    ]
    for k in range(100):
        on = 24 * (k >= 10)
        rows.append(f"{k};{0.1298 * k:.3f};{on / 5};7.0;{on};{24 - on}")
    (tmp_path / "a.csv").write_text("\r\n".join(rows).replace(".", ","), encoding="utf-8-sig")
    command = ["diagnose", "--new", str(tmp_path / "new"), str(tmp_path / "a.csv")]
    assert main(command) == 2
    assert "what was measured? expected --rig actuator" in capsys.readouterr().err
    assert main([*command, "--rig", rig]) == 0
    text = (tmp_path / "new" / "campaign.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    assert (
        table["rig"] == written and table["pressures"] == "?" and table["sample_rate_hz"] == 1000.0
    )
    (stroke,) = table["stroke"]
    assert stroke["commands"] == [[0.01, valve, 0.98], [0.01, start, 0.0]]
    assert stroke["charged_before"] == [start] and stroke["supply_pressure_pa"] == 7e5
    assert stroke["kind"] == ("N-B" if rig == "actuator" else "fixed")
    with pytest.raises(InputError, match=r"pressures: '[?]' is unknown; expected one of"):
        load_campaign(tmp_path / "new")
    (tmp_path / "new" / "campaign.toml").write_text(
        text.replace('"?"', '"gauge"'), encoding="utf-8"
    )
    campaign = load_campaign(tmp_path / "new")
    assert campaign.strokes[0].conditions.supply_pressure_pa == 801325.0
    record = campaign.record(campaign.strokes[0])
    assert record[f"pressure_{start}_pa"].max() == pytest.approx(801325.0)
    assert record.time_s[1] == 0.001


def test_an_undecided_sign_is_a_question_of_the_draft(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "Zeit [ms];Kraft [N]\n" + "".join(f"{k};1.{k:03d}\n" for k in range(9))
    )
    (tmp_path / "new").mkdir()
    _columns, asked = draft(tmp_path / "new", [tmp_path / "a.csv"])
    assert "may be 1 or 1000" in asked[0]
    assert 'decimal = "?"' in (tmp_path / "new" / "campaign.toml").read_text(encoding="utf-8")


def test_a_stored_unit_is_drafted_and_a_channel_without_values_is_not_used(tmp_path: Path) -> None:
    h5py = importlib.import_module("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, unit in (("time_s", "ms"), ("lvdt", "mm"), ("kraft", b"kN"), ("a", "mm")):
            file[name] = np.arange(300.0) * (np.nan if name == "a" else 1.0)
            file[name].attrs["unit"] = unit
    (tmp_path / "new").mkdir()
    draft(tmp_path / "new", [tmp_path / "a.h5"])
    table = tomllib.loads((tmp_path / "new" / "campaign.toml").read_text(encoding="utf-8"))
    assert table["sample_rate_hz"] == 1000.0
    assert table["columns"] == {
        "time_s": {"column": "time_s", "scale": 1e-3},
        "position_m": {"column": "lvdt", "scale": 1e-3},
        "force_n": {"column": "kraft", "scale": 1e3},
    }


def test_a_draft_without_time_states_no_rate(tmp_path: Path) -> None:
    t = np.arange(4000) / 100.0
    v = 0.1 * np.cos(t) + 0.15 * np.cos(5.0 * t)
    a = -0.1 * np.sin(t) - 0.75 * np.sin(5.0 * t)
    x = 0.1 * np.sin(t) + 0.03 * np.sin(5.0 * t)
    f = 20.0 * a + 15.0 * np.sign(v) + 80.0 * v
    noise = np.random.default_rng(1).normal(0.0, [0.0, 1e-6, 1.0], (len(t), 3))
    np.savetxt(tmp_path / "a.csv", np.column_stack([1e3 * t, x, f]) + noise, delimiter="\t")
    (tmp_path / "new").mkdir()
    draft(tmp_path / "new", [tmp_path / "a.csv"], "force")
    file = tmp_path / "new" / "campaign.toml"
    text = file.read_text(encoding="utf-8")
    columns = 'time_s = { column = "column_1", scale = 0.001 }\nposition_m = "column_2"\nforce_n = "column_3"'
    stated = text.replace("[columns]", "[columns]\n" + columns)
    file.write_text(stated, encoding="utf-8")
    assert read_motion(tmp_path / "new").step_s == pytest.approx(0.01, rel=1e-6)
    file.write_text("sample_rate_hz = 1.0\n" + stated, encoding="utf-8")
    with pytest.raises(InputError, match=r"at 1 samples a second .* another sample_rate_hz"):
        read_motion(tmp_path / "new")


def test_a_draft_is_diagnosed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    t = np.arange(8000) / 500.0
    x = 0.1 * np.sin(2.1 * t) + 0.04 * np.sin(5.7 * t)
    v = 0.21 * np.cos(2.1 * t) + 0.228 * np.cos(5.7 * t)
    a = -0.441 * np.sin(2.1 * t) - 1.2996 * np.sin(5.7 * t)
    f = 20.0 * a + 15.0 * np.sign(v) + 80.0 * v + rng.normal(0.0, 1.0, len(t))
    table = np.column_stack([1e3 * t, 1e3 * x + rng.normal(0.0, 1e-3, len(t)), 1e-3 * f])
    rows = ["; ".join(f"{value:.7f}".replace(".", ",") for value in row) for row in table]
    file = tmp_path / "bench.csv"
    file.write_text(
        "Zeit [ms];Weg [mm];Kraft [kN]\n" + "\n".join(rows) + "\n", encoding="utf-8-sig"
    )
    new = tmp_path / "new"
    assert main(["diagnose", "--new", str(new), str(file)]) == 0
    assert "push towards increasing position" in capsys.readouterr().out
    assert {"campaign.toml", "channels.png", "bench.csv"} <= {p.name for p in new.iterdir()}
    assert main(["diagnose", str(new), "--out", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "consistent"
    assert "semicolon-separated, decimal comma, UTF-8 with byte order mark" in found["findings"][0]
    assert found["body"]["mass_kg"]["value"] == pytest.approx(20.0, rel=0.02)


def test_files_that_differ_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in "ab":
        np.savetxt(
            tmp_path / f"{name}.csv",
            np.eye(9),
            header=",".join(f"{name}{k}" for k in range(9)),
            comments="",
            delimiter=",",
        )
    files = [str(tmp_path / "a.csv"), str(tmp_path / "b.csv")]
    assert main(["diagnose", "--new", str(tmp_path / "c"), *files]) == 2
    assert "other columns than" in capsys.readouterr().err


def test_a_draft_is_not_replaced_and_files_may_lie_in_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    rows = "\n".join(f"{1e-3 * k},{1e-5 * k * k},{k % 7}" for k in range(300))
    (folder / "a.csv").write_text(f"time_s,position_m,force_n\n{rows}\n")
    assert main(["diagnose", "--new", str(folder), str(tmp_path / "none.csv")]) == 2
    assert sorted(path.name for path in folder.iterdir()) == ["a.csv"]
    for deep in ("p/q/r", "p/../q/r", "bench/q"):
        assert main(["diagnose", "--new", str(tmp_path / deep), str(tmp_path / "none.csv")]) == 2
    assert [path.name for path in tmp_path.rglob("*")] == ["bench", "a.csv"]
    assert main(["diagnose", "--new", str(folder), str(folder / "a.csv")]) == 0
    (folder / "campaign.toml").write_text("# edited")
    for more, said in (
        ([], "campaign.toml: exists; expected a new folder, or --force"),
        (["--out", "x"], "--out: not together with --new"),
        (["--force"], "a second file a.csv; expected different names"),
    ):
        files = [str(folder / "a.csv")] * 2
        assert main(["diagnose", *more, "--new", str(folder), *files]) == 2
        assert said in capsys.readouterr().err
    assert (folder / "campaign.toml").read_text() == "# edited"


def test_a_measured_file_in_the_folder_is_not_replaced_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "bench"
    folder.mkdir()
    rows = "\n".join(f"{1e-3 * k},{1e-5 * k * k},{k % 7}" for k in range(300))
    (folder / "a.csv").write_text("measured before")
    (tmp_path / "a.csv").write_text(f"time_s,position_m,force_n\n{rows}\n")
    command = ["diagnose", "--new", str(folder), str(tmp_path / "a.csv")]
    assert main(command) == 2
    assert "a.csv: exists, and is not" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["a.csv"]
    assert (folder / "a.csv").read_text() == "measured before"
    assert main([*command, "--force"]) == 0
    assert (folder / "a.csv").read_text().startswith("time_s")
    for place in ("a.csv", "a.csv/new"):
        assert main(["diagnose", "--new", str(tmp_path / place), str(tmp_path / "a.csv")]) == 2
        assert f"{place}: --new: " in capsys.readouterr().err
