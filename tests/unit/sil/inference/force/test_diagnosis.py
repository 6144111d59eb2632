"""Rigs known by driving force and position: friction found, shapes refused, bad input named."""

from __future__ import annotations

import json

import numpy as np
import pytest

from can_dbc.errors import InputError
from sil.cli import main
from sil.inference.force.checks import odd_channels
from sil.inference.force.fit import Bank, acceptable, gain_in_errors, has_one_value, jackknife
from sil.inference.force.record import read_motion, smoothed
from sil.inference.thresholds import LIMITS
from tests.support.force_rig import HEAD, changed, diagnose_force, rig, written


def test_filtered_derivatives_are_those_of_one_filter() -> None:
    t = 0.05 * np.arange(400.0)
    inner = slice(60, -60)
    once, twice = smoothed(np.sin(t), 6.0), smoothed(np.sin(t), 6.0, 2)
    assert twice[inner] / 0.05**2 == pytest.approx(-once[inner], abs=1e-9)


def test_plain_friction_is_no_cause(tmp_path) -> None:
    found = diagnose_force(rig(tmp_path / "a"))
    plain = found.as_json()
    assert plain["verdict"] == "consistent"
    assert not plain["causes"] and found.refused().keys() >= {"stribeck", "friction_asymmetry"}
    standard = plain["gain"]["standardised"]
    assert standard["before"] == standard["after"] == pytest.approx(1.0, abs=0.15)
    truth = {"coulomb_n": 15.0, "viscous_n_s_m": 80.0, "offset_n": 2.0, "mass_kg": 20.0}
    for name, value in truth.items():
        item = plain["body"][name]
        assert item["low"] < value < item["high"] < item["low"] + 0.1 * value


@pytest.mark.parametrize(
    ("name", "change", "value"),
    [
        ("friction_asymmetry", {"faster_n_s_m": 30.0}, 30.0),
        ("stribeck", {"stribeck_n": 25.0}, 25.0),
        ("seal_pressure_friction", {"per_pa": 3e-5}, 3e-5),
    ],
)
def test_extra_friction_is_named_with_its_size(tmp_path, name, change, value) -> None:
    plain = diagnose_force(rig(tmp_path / "a", **change)).as_json()
    assert plain["verdict"] == "named"
    assert plain["gain"]["standardised"]["after"] == pytest.approx(1.0, abs=0.15)
    assert [c["id"] for c in plain["causes"]] == [name]
    (parameter,) = plain["causes"][0]["parameters"].values()
    assert parameter["value"] == pytest.approx(value, rel=0.2)
    assert plain["causes"][0]["probability"] > 0.9
    force = plain["gain"]["channels"]["force_n"]
    assert force["after"] < force["before"]


def test_what_would_have_been_seen_is_seen(tmp_path) -> None:
    sizes = {i["id"]: i["size"] for i in diagnose_force(rig(tmp_path / "a")).detectable()}
    kinds = {"friction_asymmetry": "faster_n_s_m", "stribeck": "stribeck_n"}
    for name, keyword in (kinds | {"seal_pressure_friction": "per_pa"}).items():
        found = diagnose_force(rig(tmp_path / keyword, **{keyword: 1.2 * sizes[name]}))
        # within what an estimate of the noise may be off by
        assert found.plain.over_noise < LIMITS.max_residual_ratio
        assert found.verdict == "named" and found.verdict_.claimed == (name,)


def test_friction_that_grows_at_rest_is_refused(tmp_path) -> None:
    found = diagnose_force(rig(tmp_path / "a", stribeck_n=-12.0))
    assert "not physical" in found.refused()["stribeck"]
    plain = found.as_json()
    assert plain["verdict"] == "unnamed" and plain["gain"]["standardised"]["after"] > 2.0
    (cause,) = plain["causes"]
    assert (cause["id"], cause["class"]) == ("unnamed", "friction")


@pytest.mark.parametrize("column", ["f", "x_mm"])
def test_a_reversed_sign_is_no_diagnosis(tmp_path, capsys, column) -> None:
    folder = changed(rig(tmp_path / "a"), column, np.negative)
    assert main(["diagnose", str(folder), "--out", str(tmp_path / "out"), "--json"]) == 1
    plain = json.loads(capsys.readouterr().out)
    assert plain["verdict"] == "cannot_tell" and not plain["causes"]
    assert "sign of the driving force" in plain["findings"][0]
    assert "sign of the driving force" in plain["headline"]
    assert "of the driving force unexplained" in plain["findings"][1]


def test_a_combination_of_parameters_is_surer_than_its_parts(tmp_path) -> None:
    # Coulomb and viscous friction move against each other; the power that they take hardly varies
    bank = Bank(read_motion(rig(tmp_path / "a", per_pa=3e-5)))
    plain = bank.attempt(())
    values, without = bank.unbounded(())
    assert values == pytest.approx(plain.values)
    assert jackknife(without - values) == pytest.approx(plain.deviations)
    parts = np.array([0.2, 0.05, 0.0, 0.0])
    together = jackknife((without - values) @ parts)
    assert together < 0.7 * np.sum(parts * plain.deviations)


def test_a_hole_in_the_force_is_refused(tmp_path) -> None:
    folder = changed(
        rig(tmp_path / "a"), "f", lambda f: np.where(np.arange(len(f)) == 40, np.nan, f)
    )
    with pytest.raises(InputError, match=r"a\.csv: line 42: 'nan' is not finite"):
        diagnose_force(folder)


@pytest.mark.parametrize(
    ("column", "change", "why"),
    [
        (
            "f",
            lambda f: np.where(abs(np.arange(len(f)) - 900) > 200, f, f[900]),
            "stuck or saturated",
        ),
        (
            "f",
            lambda f: f + 500.0 * (np.arange(len(f)) % 1000 == 500),
            "force: 10 spikes, the first",
        ),
        ("f", lambda f: np.roll(f, 100), "0.2 s late against the position"),
        ("x_mm", lambda x: x + 90.0 * (np.arange(len(x)) > 4000), "position: 1 jump,"),
    ],
)
def test_a_corrupted_record_is_no_diagnosis(tmp_path, column, change, why) -> None:
    plain = diagnose_force(changed(rig(tmp_path / "a"), column, change)).as_json()
    assert plain["verdict"] == "cannot_tell" and not plain["causes"]
    assert any(why in line for line in plain["findings"])


def test_a_stuck_force_is_found_though_a_pressure_is_added(tmp_path) -> None:
    folder = rig(tmp_path / "a", head=HEAD + "[body]\npiston_area_m2 = 1e-4\n")
    noise = np.random.default_rng(2).normal(0.0, 300.0, 10000)
    changed(folder, "pressure_pa", lambda p: p + noise)
    changed(folder, "f", lambda f: np.where(abs(np.arange(len(f)) - 900) > 200, f, f[900]))
    assert "stuck or saturated" in diagnose_force(folder).doubts[0]


def test_a_jump_is_found_between_fast_moves_too() -> None:
    """At 100 Hz a move lasts a few samples, of which each is larger than most steps of the record."""
    t = np.arange(2000) / 100.0
    there = np.interp(t % 2.0, [0.5, 0.56, 1.5, 1.56], [0.0, 10e-3, 10e-3, 0.0])
    position = there + np.random.default_rng(4).normal(0.0, 1e-5, len(t))
    force, nothing = 100.0 * np.cos(np.pi * t), np.full(len(t), np.nan)

    def found(values: np.ndarray) -> list[str]:
        return odd_channels("a.csv", np.array([values, force, nothing]), 0)

    assert found(position) == []
    for by_m, texts in ((16e-3, ["a.csv: position: 1 jump, the first at sample 1291"]), (3e-3, [])):
        assert found(position + by_m * (np.arange(len(t)) > 1290)) == texts


def test_a_position_that_stays_though_the_force_moves_the_body_is_stuck() -> None:
    t = np.arange(4000) / 500.0
    x, force = np.sin(3.0 * t), 50.0 * np.cos(3.0 * t)
    free, stuck, at_stop = x.copy(), x.copy(), np.clip(x, -1.0, 0.5)
    stuck[2000:2700] = x[2000]
    at_rest = np.where(stuck == x[2000], 0.0, force)  # no force while it stays
    for position, own, found in (
        (free, force, 0),
        (at_stop, force, 0),
        (stuck, force, 1),
        (stuck, at_rest, 0),
    ):
        signals = np.array([position, own, np.full(len(t), np.nan)])
        texts = [text for text in odd_channels("a.csv", signals, 0) if "stuck" in text]
        assert len(texts) == found
        assert all("the position keeps one value over 700 samples" in text for text in texts)


def test_a_force_that_changes_its_sign_where_the_body_turns_has_no_spikes() -> None:
    t = np.arange(4000) / 500.0
    signals = np.array([np.sin(3.0 * t), 50.0 * np.cos(t), np.full(len(t), np.nan)])
    turn, middle = 1309, 1047  # cos(3 t) = 0, sin(3 t) = 0
    for row, found in ((turn, []), (middle, [f"force: 1 spike, the first at sample {middle + 1}"])):
        changed = signals.copy()
        changed[1, row : row + 2] += 80.0
        assert odd_channels("a.csv", changed, 0) == [f"a.csv: {text}" for text in found]


def test_a_force_that_steps_where_a_move_ends_has_no_spikes() -> None:
    t = np.arange(4000) / 500.0
    signals = np.array([np.sin(3.0 * t), 50.0 * np.cos(t), np.full(len(t), np.nan)])
    middle = 1047  # sin(3 t) = 0
    signals[1, middle - 2 : middle + 1] += [26.0, 53.0, 80.0]
    assert odd_channels("a.csv", signals, 0) == []
    assert odd_channels("a.csv", signals[:, ::-1], 0) == []


def test_samples_next_to_a_turn_between_two_samples_are_not_judged(tmp_path) -> None:
    rng = np.random.default_rng(5)
    t = np.arange(6000) / 500.0
    sizes, w = 0.01 * np.array([0.6, 0.4, 0.2]), np.array([37.0, 83.0, 140.0])

    def motion(order: int, sooner: float = 0.0) -> np.ndarray:
        return np.sin(np.outer(t + sooner, w) + 0.5 * np.pi * order) @ (sizes * w**order)

    v = motion(1)
    # a drive that makes up for friction a part of a sampling step before the body turns
    f = 2.0 * motion(2) + 40.0 * np.sign(motion(1, 0.3 / 500.0)) + 20.0 * v
    x = motion(0) + rng.normal(0.0, 3e-7, len(t))
    f = f + rng.normal(0.0, 0.5, len(t))
    folder = written(tmp_path / "a", "", position_m=x, force_n=f)
    record = read_motion(folder)
    turns = np.flatnonzero(v[1:] * v[:-1] < 0.0)
    assert np.mean(np.abs(v[turns]) > 0.05 * np.quantile(np.abs(v), 0.99)) > 0.2
    away = np.abs(np.flatnonzero(record.judged)[:, None] - (turns + 0.5)).min(axis=1)
    assert away.min() > 2.0 * record.width
    found = diagnose_force(folder)
    assert found.verdict == "consistent", found.findings()


def test_the_command_writes_page_and_json(tmp_path, capsys) -> None:
    folder = rig(tmp_path / "a", faster_n_s_m=30.0)
    assert main(["diagnose", str(folder), "--out", str(tmp_path / "out")]) == 1
    assert "friction_asymmetry" in capsys.readouterr().out
    assert "friction_asymmetry" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert (tmp_path / "out" / "diagnosis.json").exists()


def test_an_area_that_changes_is_unnamed(tmp_path) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(10000) / 500.0
    x = 0.03 * (1.0 + 0.6 * np.sin(0.9 * t) + 0.3 * np.sin(2.2 * t))
    v = 0.03 * (0.54 * np.cos(0.9 * t) + 0.66 * np.cos(2.2 * t))
    p = 2e5 + 1.5e5 * np.sin(0.9 * t + 0.3) + 0.8e5 * np.sin(2.9 * t)
    f = 300.0 * v + 60.0 * np.sign(v) + 5000.0 * x - 0.012 * (1.0 - 6.0 * x) * p
    folder = written(
        tmp_path / "a",
        "piston_area_m2 = 0.012",
        position_m=x + rng.normal(0.0, 1e-6, len(t)),
        force_n=f + rng.normal(0.0, 2.0, len(t)),
        pressure_pa=p,
    )
    found = diagnose_force(folder)
    assert found.verdict == "unnamed"
    assert (found.causes()[0].id, found.causes()[0].cause_class) == ("unnamed", "geometry")


def test_what_makes_up_for_a_changing_area_is_not_named(tmp_path) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(8000) / 500.0
    w = np.array([[3.8], [8.4]])
    x = np.array([0.06, 0.02]) @ np.sin(w * t)
    v = np.array([0.06, 0.02]) @ (w * np.cos(w * t))
    a = np.array([0.06, 0.02]) @ (-(w**2) * np.sin(w * t))
    # the pressure moves with the position now and then: a cubic spring and a constant area help much
    p = 3e5 + 2e5 * np.sin(0.8 * t + 1.0) + 0.5e5 * np.sin(1.9 * t) + 2e6 * x
    f = 12.0 * a + 25.0 * np.sign(v) + 80.0 * v + 3e-4 * p * (x / 0.08) ** 2
    noise = rng.normal(0.0, 1.0, (2, len(t)))
    folder = written(
        tmp_path / "a", "", position_m=x + 2e-6 * noise[0], force_n=f + noise[1], pressure_pa=p
    )
    found = diagnose_force(folder)
    assert found.verdict == "unnamed"
    first, *others = found.causes()
    assert (first.id, first.cause_class) == ("unnamed", "geometry")
    assert "position, in proportion to pressure describes" in first.evidence
    assert all(cause.probability < 0.5 for cause in others)
    # halves of the samples contradict each other
    (cubic,) = [item for item in found.singles if item.name == "stiffness_cubic"]
    (gain,) = [item for item in found.singles if item.name == "pressure_gain"]
    pair = found.bank.attempt((*cubic.groups, *gain.groups))
    assert not has_one_value(found.bank, pair, gain.groups[0])


def test_a_second_cause_is_not_claimed_where_one_explains_all(tmp_path) -> None:
    found = diagnose_force(rig(tmp_path / "a", stribeck_n=25.0))
    one, plain, bank = found.leader, found.plain, found.bank
    (other,) = [item for item in found.singles if item.name == "friction_asymmetry"]
    both = bank.attempt((*one.groups, *other.groups))
    both.noise_n, both.count = one.noise_n, one.count
    both.deviations = 0.0 * both.deviations
    both.squares = 0.9 * one.squares
    by_names = {frozenset(item.names): item for item in (plain, one, other, both)}
    assert one.name == "stribeck" and not acceptable(both, by_names)
    one.squares, both.squares = 9.0 * one.squares, one.squares
    assert acceptable(both, by_names)


def test_a_friction_that_drives_a_positive_mass_is_no_reversed_sign(tmp_path) -> None:
    folder = rig(tmp_path / "a", faster_n_s_m=0.0)
    x = np.loadtxt(folder / "a.csv", delimiter=",", skiprows=1)[:, 1] * 1e-3
    v = np.gradient(x, 1.0 / 500.0)
    (doubt, *_) = diagnose_force(changed(folder, "f", lambda f: f - 250.0 * v)).doubts
    assert "friction would drive the body" in doubt and "with a mass of" in doubt
    assert "reversed" not in doubt


def test_a_motion_of_one_frequency_or_one_way_cannot_tell(tmp_path) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(10000) / 500.0
    x, v = 0.02 * np.sin(6.0 * t), 0.12 * np.cos(6.0 * t)
    noise = rng.normal(0.0, 0.1, (2, len(t)))
    f = (400.0 - 3.0 * 36.0) * x + 5.0 * np.sign(v) + 20.0 * v + noise[0]
    spring = diagnose_force(
        written(tmp_path / "a", "", position_m=x + 1e-5 * noise[1], force_n=f)
    ).as_json()
    assert spring["verdict"] == "cannot_tell" and "another frequency" in spring["findings"][0]
    x, v = 0.1 * t + 0.01 * np.sin(3.0 * t), 0.1 + 0.03 * np.cos(3.0 * t)
    f = 12.0 + 30.0 * v - 5.0 * 0.09 * np.sin(3.0 * t) + noise[0]
    once = diagnose_force(
        written(tmp_path / "b", "", position_m=x + 1e-5 * noise[1], force_n=f)
    ).as_json()
    assert once["verdict"] == "cannot_tell" and "one way only" in once["findings"][0]


@pytest.mark.parametrize("cubic", [False, True])
def test_enclosed_gas_is_said_to_act_as_a_spring(tmp_path, cubic) -> None:
    rng = np.random.default_rng(4)
    t = np.arange(12000) / 500.0
    size = 1.0 if cubic else 0.5
    x = size * (0.03 * np.sin(2.1 * t) + 0.015 * np.sin(5.7 * t))
    v = size * (0.063 * np.cos(2.1 * t) + 0.0855 * np.cos(5.7 * t))
    a = -size * (0.1323 * np.sin(2.1 * t) + 0.48735 * np.sin(5.7 * t))
    gas = 600.0 * ((0.15 / (0.15 - x)) ** 1.3 - 1.0)
    force = 5.0 * a + 15.0 * np.sign(v) + 80.0 * v + (3e6 * x**3 if cubic else gas)
    noise = rng.normal(0.0, 1.0, (2, len(t)))
    found = diagnose_force(
        written(tmp_path / "a", "", position_m=x + 1e-6 * noise[0], force_n=force + 2.0 * noise[1])
    ).as_json()
    causes = {cause["id"]: cause for cause in found["causes"]}
    if cubic:
        assert found["verdict"] == "named" and "stiffness_cubic" in causes
    else:  # not which part of it is volume and which is exponent
        assert "enclosed gas" in causes["stiffness"]["evidence"]


def test_a_gain_in_every_stroke_is_sure_though_strokes_differ(tmp_path) -> None:
    bank = Bank(read_motion(rig(tmp_path / "a")))
    other, item = bank.attempt(()), bank.attempt(())
    sizes = 10.0 ** np.linspace(0.0, 3.0, len(other.squares))
    other.squares, item.squares = sizes, 0.01 * sizes
    assert gain_in_errors(item, other) > 100.0
    item.squares = sizes * np.where(np.arange(len(sizes)) % 2, 0.01, 1.9)
    assert gain_in_errors(item, other) < 3.0


@pytest.mark.parametrize("force", [0.0, 5.0])
def test_a_constant_force_cannot_tell(tmp_path, capsys, force) -> None:
    folder = changed(rig(tmp_path / "a"), "f", lambda f: 0.0 * f + force)
    assert main(["diagnose", str(folder), "--out", str(tmp_path / "out"), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "cannot_tell" and not found["causes"]
    assert any("is constant" in line for line in found["findings"])


def test_another_rate_than_the_file_s_needs_no_pressure(tmp_path) -> None:
    folder = rig(tmp_path / "a", stribeck_n=25.0, head=HEAD.replace("500.0", "250.0"))
    file = folder / "a.csv"
    without = [line.rpartition(",")[0] for line in file.read_text().splitlines()]
    file.write_text("\n".join(without) + "\n", encoding="utf-8")
    found = diagnose_force(folder)
    assert found.record.step_s == 1.0 / 250.0 and found.leader.ids == ("stribeck",)
    (text,) = [line for line in found.findings() if "samples a second" in line]
    assert text.startswith("a.csv: 500 samples a second, compared at 250: by sample_rate_hz")


def test_noise_is_that_of_the_judged_samples(tmp_path) -> None:
    folder = rig(tmp_path / "a")
    names, *rows = (folder / "a.csv").read_text(encoding="utf-8").splitlines()
    rest = [row.split(",") for row in rows]
    for row in rest[2000:]:  # hardly a motion, and little noise of force
        row[1:3] = [rest[2000][1], f"{15.0 + 0.01 * float(row[2]):.6f}"]
    lines = [names, *(",".join(row) for row in rest)]
    (folder / "b.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    with (folder / "campaign.toml").open("a", encoding="utf-8") as file:
        file.write('[[stroke]]\nfile = "b.csv"\n')
    assert read_motion(folder).force_sd_n == pytest.approx(1.0, rel=0.15)


def test_a_rotary_axis_has_its_units(tmp_path) -> None:
    folder = rig(
        tmp_path / "a",
        head=HEAD.replace("position_m", "angle_rad").replace("force_n", "torque_n_m"),
    )
    diagnosis = diagnose_force(folder)
    plain, body = diagnosis.as_json(), diagnosis.as_json()["body"]
    assert body["mass_kg"]["unit"] == "kg m^2" and body["coulomb_n"]["unit"] == "N m"
    assert diagnosis.unit == "N m" and list(plain["gain"]["channels"]) == ["torque_n_m"]
    assert plain["headline"].startswith("Nothing found. Friction that differs with direction above")


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ('"f"', '"g"', "no column 'g'"),
        ('force_n = "f"', 'other = "f"', "expected a driving force"),
        ("[columns]", "bore = 3\n[columns]", "bore: unknown; expected one of"),
        ("[columns]", "[body]\nweight = 3\n[columns]", "body.weight: unknown; expected one of"),
        ("[columns]", "[body]\nslow_m_s = 5.0\n[columns]", "hardly moves"),
    ],
)
def test_bad_descriptions_are_named(tmp_path, old, new, why) -> None:
    folder = rig(tmp_path / "a", head=HEAD.replace(old, new))
    with pytest.raises(InputError, match=why.replace("[", r"\[")):
        diagnose_force(folder)


@pytest.mark.parametrize("name", ["a.csv", "./a.csv", "../a/a.csv"])
def test_a_file_of_two_strokes_is_refused(tmp_path, name) -> None:
    folder = rig(tmp_path / "a")
    with (folder / "campaign.toml").open("a", encoding="utf-8") as file:
        file.write(f'[[stroke]]\nfile = "{name}"\n')
    with pytest.raises(InputError, match=rf"stroke\[1\]\.file: '{name}' twice"):
        diagnose_force(folder)
