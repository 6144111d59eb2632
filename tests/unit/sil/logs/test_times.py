"""Times are exact: decimal text and nanoseconds, never through a float."""

from __future__ import annotations

from decimal import ROUND_HALF_UP, Decimal, localcontext

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sil.logs.times import (
    enough_decimals,
    format_ns,
    parse_date,
    parse_decimal_ns,
    utc_calendar,
    utc_ns,
    write_date,
)


@settings(deadline=None)
@given(st.integers(-(2**62), 2**62))
def test_nanoseconds_survive_as_text(time_ns: int) -> None:
    assert parse_decimal_ns(format_ns(time_ns, 9)) == time_ns
    assert parse_decimal_ns(format_ns(time_ns)) == time_ns


@settings(deadline=None)
@given(
    st.from_regex(r"\A[+-]?[0-9]{1,9}(\.[0-9]{0,20})?\Z"), st.sampled_from((1, 1000, 10**6, 10**9))
)
def test_parsing_agrees_with_decimal(text: str, unit_ns: int) -> None:
    with localcontext() as context:
        context.prec = 60
        exact = Decimal(text) * unit_ns
        expected = int(abs(exact).to_integral_value(rounding=ROUND_HALF_UP))
    assert parse_decimal_ns(text, unit_ns) == (-expected if exact < 0 else expected)


@pytest.mark.parametrize(
    ("text", "time_ns"),
    [
        ("1.4E+3", 1_400_000_000_000),
        ("2e-9", 2),
        ("1483389946.197", 1_483_389_946_197_000_000),
        (".5", 500_000_000),
        ("7.", 7_000_000_000),
        ("0.0000000005", 1),
        ("0.00000000049", 0),
    ],
)
def test_odd_numbers(text: str, time_ns: int) -> None:
    assert parse_decimal_ns(text) == time_ns


@pytest.mark.parametrize(
    "text", ["", ".", "-", "1.2.3", "1_0", " 1", "1e400", "nan", "inf", "0x1", "9" * 16, "1²"]
)
def test_no_times(text: str) -> None:
    with pytest.raises(ValueError, match="time"):
        parse_decimal_ns(text)


def test_out_of_range() -> None:
    with pytest.raises(ValueError, match="out of range"):
        parse_decimal_ns("9223372036.854775808")
    assert parse_decimal_ns("9223372036.854775807") == 2**63 - 1


def test_decimals_as_needed() -> None:
    assert format_ns(1_500_000) == "0.001500"
    assert format_ns(1_500_001) == "0.001500001"
    assert format_ns(-1_500_001, 6) == "-0.001500"
    assert format_ns(999_999_999, 6) == "1.000000"
    assert enough_decimals([(1000,), (2000,)]) == 6
    assert enough_decimals([(1000,), (2001,)]) == 9


def test_calendar() -> None:
    assert utc_ns(2023, 11, 14, 22, 13, 20, 5) == 1_700_000_000_000_000_005
    assert utc_calendar(1_700_000_000_999_999_999).isoformat() == "2023-11-14T22:13:20+00:00"


@pytest.mark.parametrize(
    ("text", "moment"),
    [
        ("Sat Sep 30 22:06:13.191 2017", (2017, 9, 30, 22, 6, 13, 191_000_000)),
        ("Sam Sep 30 22:06:13.191 2017", (2017, 9, 30, 22, 6, 13, 191_000_000)),
        ("Sat Sep 30 10:06:13.191 PM 2017", (2017, 9, 30, 22, 6, 13, 191_000_000)),
        ("Thu Dez 28 12:00:00 am 2022", (2022, 12, 28)),
        ("Thu Mai 5 12:00:00 pm 2022", (2022, 5, 5, 12)),
    ],
)
def test_dates_of_loggers(text: str, moment: tuple[int, ...]) -> None:
    assert parse_date(text) == utc_ns(*moment)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "yesterday",
        "Sat Feb 30 10:00:00 2017",
        "Sat Sep 30 13:00:00 pm 2017",
        "Sat Foo 3 1:00:00 2017",
    ],
)
def test_no_dates(text: str) -> None:
    assert parse_date(text) is None


@settings(deadline=None)
@given(st.integers(0, 4 * 10**18))
def test_written_dates_are_read(time_ns: int) -> None:
    assert parse_date(write_date(time_ns)) == time_ns // 10**6 * 10**6
