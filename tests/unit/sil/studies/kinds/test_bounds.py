"""The study `bounds`: stored policies are as soft as they say, a search is stored and continues."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from msgspec import convert
from msgspec.structs import replace

from can_dbc.errors import InputError
from plant.devices.valve import ValveTiming, seconds_to_ns, switch_schedule
from plant.parameters import load
from plant.systems.stroke import simulate
from sil.campaign.campaign import load_campaign
from sil.cli import main
from sil.studies.bounds.judge import LATER_S, Judge, Scatter, drawn
from sil.studies.bounds.policy import (
    ANSWER,
    NO_PULSE,
    STEM_SIZE,
    SwitchingDelays,
    at_releases,
    commands_of,
    edges_of,
    places_of,
    switches_of,
)
from sil.studies.bounds.search import BoundProblem, SearchProgress, random_stem, softest_alone
from sil.studies.kinds.bounds import RowKeys, read_progress, write_progress
from sil.studies.load_study import load_study, shipped
from sil.studies.table import read_table

REACHED_M_S = {
    (0.008, 0.035, 0.048): 1.095,
    (0.008, 0.035, 0.01): 1.095,
    (0.008, 0.035, 0.0): 1.095,
    (0.008, 0.005, 0.005): 1.04,
    (0.002, 0.002, 0.005): 0.96,
    (0.002, 0.002, 0.0): 0.855,
}
STORED = shipped()["bounds"].parent / "bounds"
ROW = """
name = "one"
kind = "bounds"
attempts = {attempts}
evaluations = 100
known_evaluations = 100
[[variant]]
name = "8/35 ms; 48 ms"
set = {{ opening_s = 0.008, closing_s = 0.035, delay_s = 0.048 }}
[[load]]
name = "1,300 N"
set = {{ mesh_n = [1300.0] }}
"""


def study_of_one_row(folder: Path, attempts: int) -> Path:
    path = folder / "one.toml"
    path.write_text(ROW.format(attempts=attempts))
    return path


@pytest.mark.parametrize("timing", REACHED_M_S)
def test_stored_policies_are_as_soft_as_has_been_reached(
    timing: tuple[float, float, float],
) -> None:
    names = ("opening_s", "closing_s", "delay_s")
    wanted = RowKeys(**dict(zip(names, timing, strict=True)), mesh_n=[1300.0])
    rows = [convert(each.settings, RowKeys) for each in load_study("bounds").rows()]
    stored = [read_progress(STORED / row.folder) for row in rows if wanted.can_imitate(row)]
    least_m_s = min(each.worst_m_s for progress in stored for each in progress.values())
    assert wanted in rows and least_m_s <= REACHED_M_S[timing]


def test_stored_policies_are_judged_again(tmp_path: Path) -> None:
    path, name = study_of_one_row(tmp_path, 5), "open_8_close_35_delay_48_mesh_1300"
    shutil.copytree(STORED / name, tmp_path / "bounds" / name)
    out = tmp_path / "out"
    assert main(["whatif", str(path), "--rejudge", "--out", str(out)]) == 0
    numbers = read_table(load_study(str(path)), out).numbers
    best = min(each.worst_m_s for each in read_progress(STORED / name).values())
    assert numbers["worst_m_s"][0] == pytest.approx(best, abs=1e-4)
    assert numbers["fine_m_s"][0] == pytest.approx(best, abs=0.01)
    assert numbers["open_m_s"][0] == pytest.approx(1.365, abs=1e-3)
    assert numbers["damper_m_s"][0] == pytest.approx(0.602, abs=1e-3)
    assert "8/35 ms; 48 ms" in (out / "bounds.md").read_text()
    stored = (out / "policies" / name / "campaign.toml").read_text()
    assert stored == (STORED / name / "campaign.toml").read_text()


def test_what_a_row_can_imitate() -> None:
    today, quick = (
        RowKeys(opening_s=a, closing_s=b, delay_s=0.01, mesh_n=[1300.0])
        for a, b in ((0.008, 0.035), (0.002, 0.002))
    )
    later = replace(quick, delay_s=0.017)
    assert quick.can_imitate(today) and not today.can_imitate(quick)
    assert quick.can_imitate(later) and not later.can_imitate(quick)
    assert replace(quick, delay_s=0.016).can_imitate(today) and not later.can_imitate(today)
    assert quick.can_imitate(replace(today, mesh_n=[500.0, 1300.0]))
    assert not quick.can_imitate(replace(today, b_with_f=True))


def test_slower_valves_are_imitated_stop_for_stop() -> None:
    """Quicker valves that move as slower ones, sooner, stop under each load as those do."""
    stop_m_s = []
    for opening_s, closing_s, begin_s in ((0.008, 0.035, 0.12), (0.002, 0.002, 0.12)):
        values = np.full((1, STEM_SIZE), -100.0)
        values[0, [6, 10]] = begin_s / 0.01, (0.04 - closing_s) / 0.01
        judge = Judge(
            load("nominal"),
            SwitchingDelays(opening_s, closing_s),
            np.linspace(18.0, 250.0, 9),
            (1300.0,),
            (Scatter(),),
        )
        stop_m_s.append(judge.judge(values, (), 1.0).impact_m_s)
    np.testing.assert_allclose(*stop_m_s, atol=1e-4)


@pytest.mark.slow
def test_a_search_is_stored_and_continues(tmp_path: Path) -> None:
    out, name = tmp_path / "out", "open_8_close_35_delay_48_mesh_1300"
    assert main(["whatif", str(study_of_one_row(tmp_path, 1)), "--out", str(out)]) in (0, 1)
    first = read_progress(out / "policies" / name)
    assert [len(each.history) for each in first.values()] == [1, 1]
    shutil.copytree(out / "policies", tmp_path / "bounds")
    path = study_of_one_row(tmp_path, 2)
    assert main(["whatif", str(path), "--out", str(out), "--force"]) in (0, 1)
    second = read_progress(out / "policies" / name)
    for before, after in zip(first.values(), second.values(), strict=True):
        assert after.history[:1] == before.history and len(after.history) == 2
        assert after.worst_m_s <= before.worst_m_s


def test_other_studies_have_nothing_to_judge_again(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["whatif", "faults", "--rejudge"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "does not search" in line


def test_a_policy_is_read_as_it_was_written(tmp_path: Path) -> None:
    policy = read_progress(next(STORED.iterdir()))
    assert policy["cma"].values
    write_progress(tmp_path, policy)
    assert read_progress(tmp_path) == policy
    assert read_progress(tmp_path / "nothing") == {
        "cma": SearchProgress(),
        "linear": SearchProgress(),
    }


@pytest.mark.parametrize(
    "text",
    [
        "[cma]\nvalues = [1.0]\n",
        "[cma]\nvalues = ['x']\n",
        "[other]\nknots_s = []\n",
        "[cma]\nhistory = [[1.0, 2.0, 3.0]]\n",
    ],
)
def test_a_wrong_policy_is_one_line(text: str, tmp_path: Path) -> None:
    (tmp_path / "policy.toml").write_text(text)
    with pytest.raises(InputError, match=r"policy\.toml: .*expected") as raised:
        read_progress(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("folder", sorted(STORED.iterdir()), ids=lambda path: path.name)
def test_the_plant_stops_as_the_label_says(folder: Path) -> None:
    campaign, parameters = load_campaign(folder), load(folder / "model.toml")
    stops_m_s = [float(stroke.label.split(": ")[1].split()[0]) for stroke in campaign.strokes]
    hardest = int(np.argmax(stops_m_s))
    stroke = simulate(parameters, campaign.strokes[hardest].conditions, np.array([0.0, 0.4]))
    assert stroke.impact is not None
    assert stroke.impact.speed_m_s == pytest.approx(stops_m_s[hardest], abs=1e-3)
    best = min(each.worst_m_s for each in read_progress(folder).values())
    assert max(stops_m_s) == pytest.approx(best, abs=1e-3)


PARAMETERS = load("nominal")
PAUSE = np.full((1, STEM_SIZE), NO_PULSE)
PAUSE[0, [0, 3]] = 10.5, 0.5
"""B closes once for 18 ms, while the synchronizer holds."""


@pytest.fixture(scope="module")
def judge() -> Judge:
    impulses_n_s = np.linspace(18.0, 250.0, 30)
    return Judge(
        PARAMETERS, SwitchingDelays(0.008, 0.035), impulses_n_s, (500.0, 1300.0), (Scatter(),)
    )


def test_the_plain_push_is_in_time_and_harder_under_less_mesh_force(judge: Judge) -> None:
    plain = judge.judge(np.full((1, STEM_SIZE), -100.0), (), 1.0)
    np.testing.assert_allclose(plain.late_s, 0.0, atol=1e-6)
    light, heavy = plain.impact_m_s[0, 0].max(axis=-1)
    assert light > heavy == pytest.approx(1.365, abs=1e-3)


def test_some_loads_are_judged_as_among_all(judge: Judge) -> None:
    judgement = judge.judge(PAUSE, (), 0.02)
    some = judge.judge(PAUSE, (), 0.02, slice(1, None, 4))
    np.testing.assert_array_equal(some.impact_m_s, judgement.impact_m_s[..., 1::4])


def test_the_damper_is_softer_than_the_plain_push() -> None:
    judge = Judge(
        PARAMETERS,
        SwitchingDelays(0.002, 0.002),
        np.array([250.0]),
        (1300.0,),
        (Scatter(),),
        "damper",
    )
    assert judge.plain.impact_m_s.max() == pytest.approx(0.602, abs=1e-3)


def test_a_policy_that_is_too_late_is_worth_nothing(judge: Judge) -> None:
    longer = PAUSE.copy()
    longer[0, 3] = 3.0
    judgement = judge.judge(longer, (), 0.02)
    assert judgement.late_s.max() > LATER_S
    assert judgement.worst_m_s == np.inf


def test_draws_are_fixed_and_within_the_supply_that_is_stated() -> None:
    draws = drawn(PARAMETERS)
    assert draws == drawn(PARAMETERS) and len(draws) == 32
    supply = np.exp([each.factors["supply"] for each in draws])
    assert 0.98 <= supply.min() < 0.985 and 1.015 < supply.max() <= 1.02


KNOTS_S = (0.07, 0.12, 0.2)
SIZE = STEM_SIZE + 2 * len(KNOTS_S) * sum(ANSWER.values())


def random_policies(count: int) -> np.ndarray:
    values = np.random.default_rng(3).uniform(-1.0, 8.0, (count, SIZE))
    values[:, STEM_SIZE:] *= 0.3
    return values


@pytest.mark.parametrize("fall_s", [0.035, 0.005])
def test_plungers_move_as_those_of_the_plant(fall_s: float) -> None:
    timing, count = SwitchingDelays(0.008, fall_s), 60
    releases_s = np.linspace(0.07, 0.2, count)[:, None]
    edges = edges_of(random_policies(count), KNOTS_S, releases_s, 0.005, timing)
    delays = (np.full((count, 3), each) for each in timing)
    switches = switches_of(edges, *delays)
    valve = ValveTiming(seconds_to_ns(0.008), seconds_to_ns(fall_s), 0.33, 0.35)
    for k, rows in enumerate(switches):
        commands = [(t, "BNF".index(v), duty) for t, v, duty in commands_of(edges, k)]
        expected = [(1e-9 * ns, c, u) for ns, c, u in switch_schedule(commands, valve, 3)]
        np.testing.assert_allclose(rows[np.isfinite(rows[:, 0]), :3], expected, atol=2e-9)


def test_until_the_release_is_known_all_loads_have_the_same_commands() -> None:
    values, timing = random_policies(1), SwitchingDelays(0.008, 0.035)
    edges = edges_of(values, KNOTS_S, np.array([[0.08, 0.15, 0.19]]), 0.048, timing)
    for k, known_s in ((0, 0.128), (1, 0.198)):
        first, last = (commands_of(edges, n) for n in (k, 2))
        assert [c for c in first if c[0] < known_s] == [c for c in last if c[0] < known_s]
    assert commands_of(edges, 0) != commands_of(edges, 1) != commands_of(edges, 2)


def test_an_answer_is_linear_between_knots_and_constant_outside() -> None:
    knots = np.array([[[0.0, 1.0], [2.0, 3.0]]])
    at = at_releases(knots, (0.1, 0.2), np.array([[0.05, 0.125, 0.3]]))
    np.testing.assert_allclose(at, [[[0.0, 1.0], [0.5, 1.5], [2.0, 3.0]]])


TODAY = SwitchingDelays(0.008, 0.035)


def test_each_search_is_softer_than_the_plain_push_and_forgets_nothing() -> None:
    problem = BoundProblem(PARAMETERS, TODAY, 0.01, (1300.0,), impulses_n_s=(100.0, 140.0))
    plain_m_s = problem.judge.plain.impact_m_s.max()
    for search in (problem.cma, problem.linear):
        first = search(SearchProgress(), 200)
        assert first.worst_m_s < plain_m_s
        assert problem.judged(first, problem.judge).worst_m_s[0] == first.worst_m_s
        assert search(SearchProgress(), 200) == first
        _, unused = places_of("F", len(first.knots_s))
        assert set(first.policy[0, unused.ravel()]) == {NO_PULSE}
        second = search(first, 300)
        assert second.worst_m_s <= first.worst_m_s
        assert second.history[:1] == first.history and second.history[1][0] > first.history[0][0]


def test_linear_programs_lower_the_hardest_stop() -> None:
    quick = SwitchingDelays(0.008, 0.005)
    problem = BoundProblem(PARAMETERS, quick, 0.005, (1300.0,), impulses_n_s=(100.0, 140.0))
    (begun,) = problem.begin(np.random.default_rng(0))
    end = problem.linear(SearchProgress(), 900)
    before_m_s, after_m_s = (problem.costs(each, each.policy, 1)[0] for each in (begun, end))
    assert after_m_s < before_m_s - 0.04


def test_more_knots_are_the_same_policy() -> None:
    problem, rng = BoundProblem(PARAMETERS, TODAY, 0.01, (1300.0,)), np.random.default_rng(5)
    policy, places = problem.answering(SearchProgress(values=random_stem(rng).tolist()), 2)
    values = policy.policy[0]
    values[places[-12:]] = rng.standard_normal(12)
    policy = replace(policy, values=values.tolist())
    finer, _ = problem.answering(policy, 3)
    assert len(finer.values) > len(policy.values)
    np.testing.assert_allclose(problem.answering(finer, 2)[0].values, policy.values)


@pytest.mark.slow
def test_a_load_that_is_known_is_far_softer() -> None:
    assert softest_alone(PARAMETERS, TODAY, 1300.0, 78.0, 3200).worst_m_s < 0.4
